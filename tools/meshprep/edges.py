"""How faces meet at their edges: which repeat each other, where a seam is divided, and which bound the same solid."""

from __future__ import annotations

import itertools

import numpy as np
from meshprep.surface import Faces, Surface
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def without_repeats(faces: Faces, cancel: bool) -> Faces:
    """One of each set of faces with the same corners; with ``cancel``, none of those that occur as often each way round."""
    order = np.argsort(faces, axis=1)
    # an even permutation of the sorted corners is walked one way, an odd one the other
    even = np.isin(order @ [9, 3, 1], [5, 15, 19])
    _, which = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
    net = np.bincount(which.ravel(), np.where(even, 1, -1))[which.ravel()]
    wanted = np.ones(len(faces), bool) if not cancel else (net != 0) & ((net > 0) == even)
    some = np.flatnonzero(wanted)
    _, first = np.unique(which.ravel()[some], return_index=True)
    return faces[np.sort(some[first])]


def divided_at_corners(surface: Surface, near: float) -> tuple[Faces, int]:
    """The faces with one open edge of each, at most, divided at the corners of open edges that lie on it; and how many were."""
    from scipy.spatial import cKDTree

    edges, bare = surface.half_edges[0], surface.open_half_edges
    if not len(bare):
        return surface.faces, 0
    corners = np.unique(edges[bare])
    tree, (a, b) = cKDTree(surface.vertices[corners]), np.moveaxis(surface.vertices[edges[bare]], 1, 0)
    length = np.linalg.norm(b - a, axis=1)
    around = tree.query_ball_point(0.5 * (a + b), 0.5 * length + near)
    fans: dict[int, Faces] = {}
    for i, half in enumerate(bare.tolist()):
        column, face = divmod(half, len(surface.faces))
        some = corners[around[i]]
        way, from_a = (b[i] - a[i]) / max(length[i], 1e-300), surface.vertices[some] - a[i]
        along = from_a @ way
        off = np.linalg.norm(from_a - along[:, None] * way, axis=1)
        on = (off < near) & (along > near) & (along < length[i] - near)
        if on.any() and face not in fans:
            start, end, opposite = surface.faces[face, [column, (column + 1) % 3, (column + 2) % 3]]
            rim = [start, *some[on][np.argsort(along[on])], end]
            fans[face] = np.array([[p, q, opposite] for p, q in itertools.pairwise(rim)])
    if not fans:
        return surface.faces, 0
    return np.concatenate([np.delete(surface.faces, list(fans), axis=0), *fans.values()]), len(fans)


def cut_up(surface: Surface) -> Surface:
    """``surface`` with vertices doubled so that each edge has two faces at most, and each vertex one fan of faces."""
    edges, number, uses = surface.half_edges
    n = len(surface.faces)
    face = np.tile(np.arange(n), 3)
    order = np.argsort(number, kind="stable")
    first = np.concatenate([[0], np.cumsum(uses)])
    pairs = [order[first[:-1][uses == 2][:, None] + np.arange(2)]]
    for k in np.flatnonzero(uses > 2):
        pairs.append(_about_an_edge(surface, edges, face, order[first[k] : first[k + 1]]))
    joined = np.concatenate([p.reshape(-1, 2) for p in pairs])
    # corner c of face f is number 3 f + c; a half-edge of column c runs from corner c to the next
    column = np.arange(3 * n) // n
    start, end = 3 * face + column, 3 * face + (column + 1) % 3
    a, b = joined.T
    same_way = edges[a, 0] == edges[b, 0]
    links = np.concatenate(
        [
            np.column_stack([start[a], np.where(same_way, start[b], end[b])]),
            np.column_stack([end[a], np.where(same_way, end[b], start[b])]),
        ]
    )
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), (3 * n, 3 * n))
    count, label = connected_components(graph, directed=False)
    vertices = np.zeros((count, 3))
    vertices[label] = surface.vertices[surface.faces.ravel()]
    return Surface(vertices, label.reshape(-1, 3).astype(np.int64))


def _about_an_edge(surface: Surface, edges: Faces, face: Faces, half: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs (m, 2) of the half-edges ``half`` (k,) of one edge whose faces bound the same solid there."""
    low, high = sorted(edges[half[0]])
    axis = surface.vertices[high] - surface.vertices[low]
    axis = axis / max(float(np.linalg.norm(axis)), 1e-300)
    opposite = surface.corners[face[half]].sum(1) - surface.vertices[low] - surface.vertices[high]
    out = opposite - surface.vertices[low]
    out = out - (out @ axis)[:, None] * axis
    x = out[0] / max(float(np.linalg.norm(out[0])), 1e-300)
    # faces that lie on each other are distinguished by their direction, not by rounding: what they bound does not join
    angle = np.round((np.arctan2(out @ np.cross(axis, x), out @ x) + 1e-7) % (2 * np.pi), 6)
    forwards = edges[half, 0] == low
    turn = np.lexsort((~forwards, angle))
    todo, pairs = turn.tolist(), []
    if forwards.sum() * 2 != len(half):  # who bounds what is ambiguous: neighbours are paired
        pairs = [turn[i : i + 2] for i in range(0, len(turn) - 1, 2)]
        return half[np.array(pairs)].reshape(-1, 2)
    # seen along the axis, a face walked forwards has its solid on the side of greater angles' opposite: the solid lies between
    # a face walked backwards and the next one walked forwards
    while todo:
        for i in range(len(todo)):
            a, b = todo[i], todo[(i + 1) % len(todo)]
            if not forwards[a] and forwards[b]:
                pairs.append([a, b])
                todo = [t for t in todo if t not in (a, b)]
                break
    return half[np.array(pairs)]


def canonical(faces: Faces) -> Faces:
    """Faces with the smallest corner first, walked as they are."""
    start = faces.argmin(1)[:, None]
    return np.take_along_axis(faces, (start + np.arange(3)) % 3, axis=1)
