"""The surface in a glTF 2.0 file: the default scene's triangles, placed. What is not read is refused by its name."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geomtact.errors import MeshError
from geomtact.geometry.gltf_data import GltfData
from geomtact.se3 import Array, apply

_READ = {"KHR_mesh_quantization", "EXT_mesh_gpu_instancing", "KHR_animation_pointer", "KHR_node_visibility"}
# Extensions that leave the surface as it is, so that a file may require them.
_LOOKS = re.compile(
    r"(KHR|EXT|MSFT|ADOBE)_(materials|texture|lights|packing)_(?!displacement)\w+"
    r"|KHR_(xmp|xmp_json_ld|techniques_webgl|audio_emitter|node_hoverability|node_selectability)"
    r"|EXT_(mesh_manifold|mesh_features|instance_features|structural_metadata)"
    r"|FB_(geometry_metadata|ngon_encoding)|CESIUM_primitive_outline|MSFT_lod"
)
_POINTS_AND_LINES, _TRIANGLES, _STRIP, _FAN = (0, 1, 2, 3), 4, 5, 6


def read_gltf(path: Path) -> tuple[Array, NDArray[np.int64]]:
    """The triangles of the default scene of a .gltf or .glb file, in the scene's frame.

    Sparse accessors, normalised integers, instances and morph targets are read, and nodes that mirror keep the outside
    outside. Points, lines and other scenes are left out.

    Returns
    -------
    vertices : (V, 3) float64 [m]
    faces : (F, 3) int64

    Raises
    ------
    MeshError
        Not glTF 2.0, cut short, a buffer is missing, or the surface depends on what is not read: a compression or another
        required extension, a skin, an animation.
    """
    try:
        data = GltfData(path)
        _check(data.content)
        pieces = list(_pieces(data))
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from None
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001 -- JSON may hold anything anywhere, which fails in more ways than can be listed
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:100]}"
        raise MeshError(f"{path}: is no valid glTF 2.0 ({reason}); export it again") from None
    first = np.cumsum([0, *(len(vertices) for vertices, _ in pieces)])
    faces = [faces + start for (_, faces), start in zip(pieces, first, strict=False)]
    if not sum(map(len, faces)):
        what = "only points or lines" if pieces else "nothing in the scene that it shows"
        raise MeshError(f"{path}: expected a surface of triangles, found {what}; export the mesh with its faces")
    vertices, triangles = np.concatenate([vertices for vertices, _ in pieces]), np.concatenate(faces)
    if not np.isfinite(vertices[triangles]).all():
        raise MeshError(f"{path}: vertices hold NaN or infinity; export the mesh again")
    return vertices, triangles


def _check(content: Mapping[str, Any]) -> None:
    """Refuse another version, and required extensions that may change the surface."""
    version = str(content["asset"]["version"])
    if not version.startswith("2."):
        raise MeshError(f"expected glTF 2.0, got version {version}; export it as glTF 2.0")
    for name in content.get("extensionsRequired", []):
        if name not in _READ and not _LOOKS.fullmatch(name):
            raise MeshError(f"needs the glTF extension {name}, which is not read; export it without that")


def _pieces(data: GltfData) -> Iterator[tuple[Array, NDArray[np.int64]]]:
    """Vertices (V, 3) and triangles (F, 3) of each primitive of the default scene, wherever it is placed."""
    animated = dict(_animated(data.content))
    seen: set[int] = set()
    stack = [(index, np.eye(4), "") for index in _roots(data)]
    while stack:
        index, T_scene_parent, moved = stack.pop()
        if index in seen:
            raise MeshError(f"node {index} is in the scene twice, or in a circle; export it again")
        seen.add(index)
        node = data.at("nodes", index)
        extensions = node.get("extensions", {})
        moved = moved or animated.get(index, "")
        if not extensions.get("KHR_node_visibility", {}).get("visible", True):
            moved = "it is hidden by the glTF extension KHR_node_visibility; show or delete it, and export it again"
        T_scene_node = T_scene_parent @ _placed(node)
        stack += [(child, T_scene_node, moved) for child in node.get("children", [])]
        if "mesh" not in node:
            continue
        if "skin" in node:
            moved = "a skin poses it; apply the skin and export it without one"
        if moved:
            raise MeshError(f"node {node.get('name', index)!r}: {moved}")
        placements = T_scene_node[None]
        if "EXT_mesh_gpu_instancing" in extensions:
            placements = T_scene_node @ _instances(data, extensions["EXT_mesh_gpu_instancing"])
        mesh = data.at("meshes", node["mesh"])
        weights = node.get("weights", mesh.get("weights", []))
        for primitive in mesh["primitives"]:
            if primitive.get("mode", _TRIANGLES) in _POINTS_AND_LINES:
                yield np.zeros((0, 3)), np.zeros((0, 3), np.int64)
                continue
            vertices, faces = _primitive(data, primitive, weights)
            for T in placements:
                yield apply(T, vertices), faces if np.linalg.det(T[:3, :3]) >= 0 else faces[:, ::-1]


def _roots(data: GltfData) -> list[int]:
    """The nodes of the default scene, or of the only one; of a file without scenes all that no other holds."""
    scenes = data.content.get("scenes", [])
    if "scene" in data.content or len(scenes) == 1:
        return data.at("scenes", data.content.get("scene", 0)).get("nodes", [])
    if scenes:
        raise MeshError(f"it has {len(scenes)} scenes and names none as the one to show; export one scene alone")
    nodes = data.content.get("nodes", [])
    if not nodes and data.content.get("meshes"):
        raise MeshError("it has meshes, but no scene that places them; export it with its scene")
    children = {child for node in nodes for child in node.get("children", [])}
    return [index for index in range(len(nodes)) if index not in children]


def _animated(content: Mapping[str, Any]) -> Iterator[tuple[int, str]]:
    """The nodes that an animation moves, and what to say of them."""
    for animation in content.get("animations", []):
        for channel in animation["channels"]:
            target = channel["target"]
            pointer = target.get("extensions", {}).get("KHR_animation_pointer", {}).get("pointer", "")
            pointed = re.match(r"/nodes/(\d+)/", pointer)
            index = int(pointed[1]) if pointed else target.get("node")
            if index is not None:
                yield index, "an animation moves it; export it as it is touched, without animations"


def _placed(node: Mapping[str, Any]) -> Array:
    """``T_parent_node`` (4, 4), which may scale, shear and mirror."""
    if "matrix" not in node:
        turn, scale = node.get("rotation", [0, 0, 0, 1]), node.get("scale", [1, 1, 1])
        return _composed(*(np.array([v], float) for v in (node.get("translation", [0, 0, 0]), turn, scale)))[0]
    T = np.array(node["matrix"], float).reshape(4, 4).T
    if np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise MeshError("a node's matrix is no affine map: its last row is not 0 0 0 1; export it again")
    return T


def _instances(data: GltfData, instancing: Mapping[str, Any]) -> Array:
    """``T_node_instance`` (n, 4, 4) of EXT_mesh_gpu_instancing; one if instances differ only in attributes of other names."""
    named = {"TRANSLATION": ("VEC3", [0, 0, 0]), "ROTATION": ("VEC4", [0, 0, 0, 1]), "SCALE": ("VEC3", [1, 1, 1])}
    attributes = instancing["attributes"]
    found = {name: data.numbers(attributes[name], named[name][0], instancing) for name in named if name in attributes}
    if not found:  # all lie on each other
        return np.eye(4)[None]
    n = len(next(iter(found.values())))
    return _composed(*(found.get(name, np.tile(default, (n, 1))) for name, (_, default) in named.items()))


def _composed(translation: Array, quat_xyzw: Array, scale: Array) -> Array:
    """(n, 4, 4) that scale, then turn, then move."""
    T = np.tile(np.eye(4), (len(translation), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(quat_xyzw).as_matrix() * scale[:, None, :]
    T[:, :3, 3] = translation
    return T


def _primitive(data: GltfData, primitive: Mapping[str, Any], weights: list[float]) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (V, 3) and triangles (F, 3) of a primitive, in its node's frame, with its morph targets' ``weights``."""
    attributes = primitive["attributes"]
    if "POSITION" not in attributes:
        raise MeshError("a part of its mesh has no positions; export it again")
    vertices = data.numbers(attributes["POSITION"], "VEC3", primitive)
    for weight, target in zip(weights, primitive.get("targets", []), strict=False):
        if weight and "POSITION" in target:
            vertices = vertices + weight * data.numbers(target["POSITION"], "VEC3", primitive, or_zeros=True)
    if "indices" in primitive:
        corners = data.numbers(primitive["indices"], "SCALAR", primitive)[:, 0].astype(np.int64)
    else:
        corners = np.arange(len(vertices))
    if len(corners) and corners.max() >= len(vertices):
        raise MeshError(f"a face names a vertex that is not there (of {len(vertices)}); export the mesh again")
    return vertices, _faces(primitive.get("mode", _TRIANGLES), corners)


def _faces(mode: int, corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles (F, 3) of a list, strip or fan of corners, all wound alike."""
    if mode == _TRIANGLES:
        if len(corners) % 3:
            raise MeshError(f"its triangles have {len(corners)} corners, no multiple of three; export it again")
        return corners.reshape(-1, 3)
    k = np.arange(max(len(corners) - 2, 0))
    if mode == _STRIP:
        return corners[np.stack([k, k + 1 + k % 2, k + 2 - k % 2], axis=1)]
    if mode == _FAN:
        return corners[np.stack([k + 1, k + 2, 0 * k], axis=1)]
    raise MeshError(f"its mesh is of mode {mode}, which glTF 2.0 does not have; export it again")
