"""The repairs, one after the other: each takes a surface and gives a better one, and names what it changed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pymeshlab
from meshprep import Refused
from meshprep.edges import canonical, cut_up, divided_at_corners, without_repeats
from meshprep.surface import Array, Surface, label_faces

_SEAM = 1e-5  # of the size, by which a corner may lie beside an edge that it divides
# of the size, and at least in the file's unit, by which surfaces that touch are moved apart
_APART, _LEAST_APART = 2e-6, 5e-8


@dataclass(frozen=True)
class Options:
    """What may be done to a mesh. Lengths are in the mesh's own unit.

    Attributes
    ----------
    skip : names of steps that are left out
    merge : distance below which vertices are one
    max_hole : span of the largest hole that is filled
    max_faces : beyond which a mesh is made coarser
    max_error : by which coarsening may move the surface
    largest : whether all bodies but the largest are dropped
    """

    skip: frozenset[str]
    merge: float
    max_hole: float
    max_faces: int
    max_error: float
    largest: bool = False


@dataclass(frozen=True)
class Hole:
    """A hole that was filled: area, span (largest distance of two corners of its rim) and middle (3,), in the mesh's unit."""

    area: float
    span: float
    middle: list[float]


@dataclass
class Work:
    """A mesh under repair.

    Attributes
    ----------
    surface : as it is now
    changes : what each step did, in words, by its name; steps that changed nothing are not named
    holes, patches : holes filled, and the corners (n, 3, 3) of the faces that fill them
    dropped : what was given up of the original on purpose: whole bodies
    coherent : whether neighbouring faces agreed about the outside
    """

    surface: Surface
    changes: dict[str, str] = field(default_factory=dict)
    holes: list[Hole] = field(default_factory=list)
    patches: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    dropped: list[Surface] = field(default_factory=list)
    coherent: bool = True


def repair(surface: Surface, options: Options) -> Work:
    """``surface`` after all steps that are not to be skipped.

    Raises
    ------
    Refused
        It cannot be made a closed solid within what the options allow.
    """
    work = Work(surface)
    for name, step in STEPS.items():
        if name not in options.skip:
            step(work, options)
    return work


def merge(work: Work, options: Options) -> None:
    """Vertices closer than a millionth of the size are one: exporters round the same corner in different ways."""
    before = work.surface
    meshes = _meshset(before)
    meshes.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(options.merge))
    work.surface = _kept_exactly(_surface(meshes), before)
    gone = len(before.vertices) - len(work.surface.vertices)
    if gone:
        work.changes["merge"] = f"{gone} vertices merged with others less than {options.merge:.3g} away"


def degenerate(work: Work, options: Options) -> None:
    """Faces without area and faces that repeat others are dropped; two that cover each other from both sides, both."""
    faces = work.surface.faces
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
    lines = len(work.surface.faces) - len(faces)
    if not len(faces):
        raise Refused("every face has shrunk to a line; export the mesh again")
    once, cancelled = without_repeats(faces, False), without_repeats(faces, True)
    # a sheet of no thickness has two sides: without both nothing opens; a face stored twice, turned, is one face
    best = min((once, cancelled), key=lambda some: work.surface.with_faces(some).open_edges)
    if not len(best):
        raise Refused("its faces cover each other from both sides and enclose nothing; give a solid object")
    repeats = len(faces) - len(best)
    surface, flat = _without_slivers(work.surface.with_faces(best))
    said = [(lines, "shrunk to a line"), (repeats, "repeated"), (flat, "of no area")]
    if any(count for count, _ in said):
        work.changes["degenerate"] = "faces dropped: " + ", ".join(f"{n} {why}" for n, why in said if n)
    work.surface = surface.tidied()


def seams(work: Work, options: Options) -> None:
    """Open edges on which corners of others lie are divided there: the sides of a seam that are cut up differently then meet."""
    surface, divided = work.surface, 0
    while True:
        faces, count = divided_at_corners(surface, _SEAM * surface.size)
        if not count:
            break
        surface, divided = surface.with_faces(faces), divided + count
    if divided and surface.open_edges < work.surface.open_edges:
        work.changes["seams"] = f"{divided} edges divided where corners of others lie on them"
        work.surface = surface


def cut(work: Work, options: Options) -> None:
    """Where more than two faces share an edge, they are sorted about it, and those that bound the same solid stay together."""
    surface = work.surface
    crowded = surface.crowded_edges
    apiece = cut_up(surface)
    if len(apiece.vertices) > len(surface.vertices):
        more = len(apiece.vertices) - len(surface.vertices)
        work.changes["cut"] = f"{crowded} edges of more than two faces cut, {more} vertices doubled"
        work.surface = apiece


def winding(work: Work, options: Options) -> None:
    """Neighbouring faces agree about the outside, and every body is turned so that its outside is outside."""
    surface = work.surface
    before = canonical(surface.faces)
    work.coherent = surface.coherent
    if not work.coherent and not surface.crowded_edges:
        meshes = _meshset(surface)
        meshes.meshing_re_orient_faces_coherently()
        surface = _kept_exactly(_surface(meshes), surface)
        if len(surface.faces) != len(before):
            raise Refused("the surface has only one side (as a Moebius strip has); export the object as a solid")
    surface = _outwards(surface, work.coherent)
    turned = int((canonical(surface.faces) != before).any(1).sum())
    if turned:
        work.changes["winding"] = f"{turned} of {len(before)} faces turned round"
        work.surface = surface


def holes(work: Work, options: Options) -> None:
    """Holes are filled with flat triangles, if none is wider than is allowed."""
    surface = work.surface
    if not surface.open_edges or surface.crowded_edges:
        return
    meshes = _meshset(surface)
    meshes.meshing_close_holes(maxholesize=len(surface.faces) + 3, selfintersection=False, refinehole=False)
    filled = _kept_exactly(_surface(meshes), surface)
    new = filled.faces[len(surface.faces) :]
    if (filled.faces[: len(surface.faces)] != surface.faces).any():
        raise Refused("its holes could not be filled; close the surface in a mesh editor")
    piece = label_faces(new)
    rims = [filled.vertices[np.unique(new[piece == k])] for k in range(int(piece.max(initial=-1)) + 1)]
    _check_rims(rims, 2 * options.max_error)
    areas = np.bincount(piece, filled.areas[len(surface.faces) :])
    for rim, area in zip(rims, areas.tolist(), strict=True):
        work.holes.append(Hole(area, _span(rim), rim.mean(0).tolist()))
    widest = max(work.holes, key=lambda hole: hole.span, default=None)
    if widest is not None and widest.span > options.max_hole:
        where = ", ".join(f"{x:.4g}" for x in widest.middle)
        raise Refused(
            f"a hole {widest.span:.4g} across at ({where}), the widest of {len(work.holes)}, is wider than "
            f"{options.max_hole:.4g} (in the file's unit); close it in CAD, or allow it with --max-hole, in mm"
        )
    if len(new):
        work.patches = filled.vertices[new]
        work.changes["holes"] = f"{len(work.holes)} filled with {len(new)} faces, the widest {widest.span:.3g} across"
        work.surface = _outwards(filled, work.coherent)


def bodies(work: Work, options: Options) -> None:
    """Specks are dropped, and all but the largest body where that is asked for; all others are kept as they lie."""
    surface, body = work.surface, work.surface.bodies
    count = int(body.max()) + 1
    volume = np.abs(surface.volumes)
    keep = volume > 1e-9 * surface.size**3
    if surface.open_edges:
        return
    if options.largest and keep.any():
        keep &= surface.owners == surface.volumes.argmax()  # with the cavities in it
    if keep.all():
        return
    if not keep.any():
        raise Refused("the surface encloses no volume; give a solid object")
    work.dropped.append(surface.with_faces(surface.faces[~keep[body]]).tidied())
    work.surface = surface.with_faces(surface.faces[keep[body]]).tidied()
    work.changes["bodies"] = f"{int((~keep).sum())} of {count} bodies dropped"


def intersections(work: Work, options: Options) -> None:
    """Where the surface passes through itself, the union of all that it encloses takes its place."""
    surface = work.surface
    if surface.open_edges or surface.torn_edges:
        return
    meshes = _meshset(surface)
    meshes.compute_selection_by_self_intersections_per_face()
    crossing = meshes.current_mesh().selected_face_number()
    if not crossing:
        return
    meshes = _meshset(surface)
    try:
        meshes.generate_boolean_union(first_mesh=0, second_mesh=0)
    except pymeshlab.PyMeshLabException:
        raise Refused(
            f"{crossing} faces pass through others, and what they enclose is ambiguous; unite the bodies in CAD"
        ) from None
    work.surface = cut_up(_kept_exactly(_surface(meshes), surface)).tidied()
    work.changes["intersections"] = f"{crossing} faces passed through others: united"


def coarser(work: Work, options: Options) -> None:
    """A mesh of too many faces is made coarser, as far as the surface moves no more than is allowed."""
    surface = work.surface
    if len(surface.faces) <= options.max_faces:
        return
    from meshprep.proof import distances

    for share in (0.0, 0.5, 0.75, 0.9):  # share of the step from the target back to the present surface
        wanted = int(options.max_faces + share * (len(surface.faces) - options.max_faces))
        meshes = _meshset(surface)
        meshes.meshing_decimation_quadric_edge_collapse(targetfacenum=wanted, preservetopology=True, qualitythr=0.5)
        fewer = _surface(meshes).tidied()
        if (
            not fewer.open_edges
            and max(distances(surface, fewer).max(), distances(fewer, surface).max()) <= options.max_error
        ):
            work.changes["coarser"] = f"{len(surface.faces)} faces made {len(fewer.faces)}"
            work.surface = fewer
            return


def apart(work: Work, options: Options) -> None:
    """Surfaces that touch along an edge or at a point are moved apart a little, as files join what coincides."""
    surface = work.surface
    _, twin, count = np.unique(surface.vertices, axis=0, return_inverse=True, return_counts=True)
    touching = count[twin.ravel()] > 1
    if not touching.any():
        return
    middle = surface.corners.mean(1)
    inwards = np.zeros_like(surface.vertices)
    for k in range(3):
        np.add.at(inwards, surface.faces[:, k], middle - surface.corners[:, k])
    length = np.linalg.norm(inwards, axis=1, keepdims=True)
    vertices = surface.vertices.copy()
    by = max(_APART * surface.size, _LEAST_APART)
    step = by * inwards / np.maximum(length, 1e-300)
    vertices[touching] += step[touching]
    work.surface = Surface(vertices, surface.faces)
    work.changes["apart"] = f"{int(touching.sum())} vertices moved by {by:.2g}, off surfaces that they touch"


STEPS: dict[str, Callable[[Work, Options], None]] = {
    step.__name__: step
    for step in (merge, degenerate, seams, cut, winding, holes, bodies, intersections, coarser, apart)
}


def _without_slivers(surface: Surface) -> tuple[Surface, int]:
    """Faces whose three corners lie on a line are flipped away into their neighbours, so that nothing opens."""
    flat = int((surface.areas <= 1e-12 * surface.size**2).sum())
    if not flat:
        return surface, 0
    meshes = _meshset(surface)
    try:
        meshes.meshing_remove_t_vertices(method="Edge Flip", threshold=1e4, repeat=True)
    except pymeshlab.PyMeshLabException:  # it asks for two faces an edge; what has no area does no harm
        return surface, 0
    flipped = _kept_exactly(_surface(meshes), surface)
    faces = flipped.faces[flipped.areas > 1e-12 * surface.size**2]
    better = flipped.with_faces(faces)
    if not len(faces):
        raise Refused("no face has any area; export the mesh again")
    return (better, flat) if better.open_edges <= surface.open_edges else (surface, 0)


def _outwards(surface: Surface, coherent: bool) -> Surface:
    """Bodies turned so that the outside is outside, cavities inwards.

    Where the faces were ``coherent``, which body is a cavity is as the file says: only what is wound inwards and lies in no other
    is turned, with all that lies in it. Else what lies in an odd number of others is a cavity.
    """
    volume = surface.volumes
    if surface.open_edges:  # what lies where is decided once all is closed
        turn = volume < 0 if len(volume) == 1 else np.zeros(len(volume), bool)
    else:
        contains, crosses = surface.contained
        lost = np.flatnonzero((volume < 0) & crosses.any(1) & ~contains.any(1))
        if coherent and len(lost):
            where = ", ".join(f"{x:.4g}" for x in surface.corners[surface.bodies == lost[0]].mean((0, 1)))
            raise Refused(f"a body wound inwards, about ({where}), passes through another; subtract it in CAD")
        depth = contains.sum(1)
        if coherent:
            inverted = (volume < 0) & (depth == 0)
            turn = inverted | (contains & inverted).any(1)
        else:
            turn = (volume < 0) != (depth % 2 == 1)
    faces = surface.faces.copy()
    flip = turn[surface.bodies]
    faces[flip] = faces[flip][:, ::-1]
    return surface.with_faces(faces)


def _check_rims(rims: list[Array], near: float) -> None:
    """Refuse to fill holes whose rims, (n, 3) each, lie on each other: two sides of a seam, behind which there is no hole."""
    from scipy.spatial import cKDTree

    for i, rim in enumerate(rims):
        tree = cKDTree(rim)
        for other in rims[i + 1 :]:
            apart = tree.query(other)[0]
            if apart.max() <= near:
                where = ", ".join(f"{x:.4g}" for x in other.mean(0))
                raise Refused(
                    f"two rims lie {apart.max():.2g} apart about ({where}): a seam, not a hole; join them with --merge "
                    f"{1.5 * apart.max():.1g} (in the file's unit)"
                )


def _span(points: Array) -> float:
    """Largest distance of two of ``points`` (n, 3)."""
    from scipy.spatial.distance import pdist

    return float(pdist(points[:: max(1, len(points) // 500)]).max(initial=0.0))


def _meshset(surface: Surface) -> pymeshlab.MeshSet:
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(surface.vertices, surface.faces))
    return meshes


def _surface(meshes: pymeshlab.MeshSet) -> Surface:
    mesh = meshes.current_mesh()
    return Surface(np.array(mesh.vertex_matrix(), float), np.array(mesh.face_matrix(), np.int64))


def _kept_exactly(after: Surface, before: Surface) -> Surface:
    """``after`` with every vertex that lies on one of ``before``, but for rounding, given that one's very coordinates."""
    from scipy.spatial import cKDTree

    distance, nearest = cKDTree(before.vertices).query(after.vertices)
    vertices = after.vertices.copy()
    same = distance <= 1e-12 * before.size
    vertices[same] = before.vertices[nearest[same]]
    return Surface(vertices, after.faces)
