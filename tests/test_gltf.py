"""glTF files: each surface is read as glTF 2.0 places it, and what is not read is refused by its name."""

import base64
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from geomtact.errors import MeshError
from geomtact.geometry.gltf_file import read_gltf
from geomtact.geometry.mesh_file import load_mesh
from geomtact.se3 import apply, random_rotations, transform

BOX = trimesh.creation.box((0.02, 0.03, 0.05))
CORNERS, FACES = np.asarray(BOX.vertices, np.float32), np.asarray(BOX.faces)
VOLUME = 0.02 * 0.03 * 0.05
_CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}


class Made:
    """A glTF file in the making: one buffer, its views and accessors, and a scene of one node with one mesh."""

    def __init__(self, vertices=CORNERS, indices=FACES, **primitive):
        self.data = b""
        self.content = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
        self.content |= {"bufferViews": [], "accessors": [], "meshes": []}
        self.primitive = {"attributes": {"POSITION": self.accessor(vertices)}, **primitive}
        if indices is not None:
            self.primitive["indices"] = self.accessor(np.asarray(indices, np.uint32).ravel())
        self.content["meshes"].append({"primitives": [self.primitive]})

    @property
    def node(self):
        return self.content["nodes"][0]

    def view(self, array, **entries):
        self.content["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes, **entries}
        )
        self.data += array.tobytes()
        return len(self.content["bufferViews"]) - 1

    def accessor(self, array, **entries):
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[1 if array.ndim == 1 else array.shape[1]]
        code = _CODES[array.dtype.str[1:]]
        entry = {"bufferView": self.view(array), "componentType": code, "count": len(array), "type": kind, **entries}
        self.content["accessors"].append({key: value for key, value in entry.items() if value is not None})
        return len(self.content["accessors"]) - 1

    def requires(self, *names):
        self.content |= {"extensionsUsed": list(names), "extensionsRequired": list(names)}
        return self

    def gltf(self, path, uri=None):
        uri = uri or "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        buffers = [{"byteLength": len(self.data), "uri": uri}]
        path.write_text(json.dumps({**self.content, "buffers": buffers}))
        return path

    def glb(self, path):
        text = json.dumps({"buffers": [{"byteLength": len(self.data)}], **self.content}).encode()
        body = b""
        for kind, chunk, fill in ((b"JSON", text, b" "), (b"BIN\0", self.data, b"\0"), (b"MORE", b"skip", b"")):
            chunk += fill * (-len(chunk) % 4)
            body += struct.pack("<I", len(chunk)) + kind + chunk
        path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)
        return path


def volume(vertices, faces):
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


def assert_is(path, vertices=CORNERS, signed_volume=VOLUME, bodies=1):
    """The file's surface has those corners, in any order, and encloses that volume, outside outside."""
    found, faces = read_gltf(path)
    expected = np.unique(np.round(vertices, 8), axis=0)
    np.testing.assert_allclose(np.unique(np.round(found[faces].reshape(-1, 3), 8), axis=0), expected, atol=2e-8)
    assert volume(found, faces) == pytest.approx(signed_volume, rel=1e-5)
    assert len(faces) == 12 * bodies
    load_mesh(path)  # closed, and its outside is outside


def refused(words, path):
    with pytest.raises(MeshError, match=words) as caught:
        load_mesh(path)
    text = str(caught.value)
    assert "\n" not in text
    assert str(path) in text
    assert "unit" not in text


# Everything registered with Khronos that may change, hold or hide geometry, drafts in wide use, and an invented one.
READ = {"KHR_mesh_quantization", "EXT_mesh_gpu_instancing", "KHR_animation_pointer", "KHR_node_visibility"}
HARMLESS = {
    *(f"KHR_materials_{name}" for name in ("unlit", "variants", "ior", "clearcoat", "pbrSpecularGlossiness")),
    *("KHR_texture_transform", "KHR_texture_basisu", "KHR_lights_punctual", "KHR_xmp_json_ld"),
    *("EXT_texture_webp", "EXT_texture_avif", "EXT_lights_image_based", "EXT_mesh_manifold", "EXT_mesh_features"),
    *("EXT_structural_metadata", "MSFT_texture_dds", "MSFT_lod", "MSFT_packing_occlusionRoughnessMetallic"),
    *("ADOBE_materials_thin_transparency", "CESIUM_primitive_outline", "FB_ngon_encoding"),
}
NAMED = {
    *("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression", "KHR_gaussian_splatting"),
    *("KHR_implicit_shapes", "KHR_physics_rigid_bodies", "KHR_interactivity", "KHR_materials_displacement"),
    *("EXT_primitive_voxels", "EXT_mesh_primitive_restart", "EXT_mesh_polygon", "CESIUM_RTC", "KHR_binary_glTF"),
    *("AGI_articulations", "MPEG_mesh_linking", "VRMC_node_constraint", "ACME_bends_meshes"),
}


@pytest.mark.parametrize("name", sorted(READ | HARMLESS | NAMED))
def test_every_required_extension_is_read_or_named(tmp_path, name):
    path = Made().requires(name).glb(tmp_path / "a.glb")
    if name in NAMED:
        refused(f"needs the glTF extension {name}, which is not read", path)
    else:
        assert_is(path)


@pytest.mark.parametrize("name", sorted(READ | HARMLESS | NAMED))
def test_data_that_only_an_extension_has_is_named_even_if_it_is_not_required(tmp_path, name):
    made = Made(extensions={name: {"bufferView": 0}})
    made.content["extensionsUsed"] = [name]
    assert_is(made.glb(tmp_path / "fallback.glb"))
    del made.content["accessors"][0]["bufferView"]
    refused(f"lies in the glTF extension {name}", made.glb(tmp_path / "a.glb"))
    made = Made()
    made.content["bufferViews"][0] |= {"buffer": 1, "byteOffset": 0, "extensions": {name: {"buffer": 0}}}
    made.content["buffers"] = [{"byteLength": len(made.data)}, {"byteLength": 96, "extensions": {name: {}}}]
    refused(f"lies in the glTF extension {name}", made.glb(tmp_path / "b.glb"))


@pytest.mark.parametrize("write", [Made.glb, Made.gltf])
def test_the_surface_is_read_from_binary_and_text(tmp_path, write):
    assert_is(write(Made(), tmp_path / "a.gltf"))


@pytest.mark.parametrize(
    ("uri", "name"),
    [("my%20part.bin", "my part.bin"), ("a b.bin", "a b.bin"), ("100%25.bin", "100%.bin"), ("x%20.bin", "x%20.bin")]
    + [("sub/%C3%BC.bin", "sub/ü.bin"), (r"sub\a.bin", "sub/a.bin"), ("%FF.bin", "\udcff.bin")],
)
def test_a_buffer_beside_the_file_is_found_by_its_name(tmp_path, uri, name):
    made = Made()
    path = made.gltf(tmp_path / "a.gltf", uri)
    refused("is not there; copy it beside", path)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(made.data)
    assert_is(path)
    (tmp_path / name).write_bytes(made.data[:-1])
    refused("buffer 0 is cut short: expected 240 bytes, found 239", path)


def test_a_buffer_elsewhere_is_named(tmp_path):
    refused(
        "buffer lies at https://example.org/a.bin; save", Made().gltf(tmp_path / "a.gltf", "https://example.org/a.bin")
    )
    assert_is(Made().gltf(tmp_path / "b.gltf", "data:," + "".join(f"%{byte:02x}" for byte in Made().data)))


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2"])
@pytest.mark.parametrize("normalized", [True, False])
def test_quantized_positions_have_their_size(tmp_path, kind, normalized):
    limit = np.iinfo(kind).max
    low = 0 if kind[0] == "u" else -limit
    integers = np.where(CORNERS > 0, limit, low).astype(kind)
    made = Made(np.pad(integers, ((0, 0), (0, 1))))  # rows begin at multiples of four bytes
    made.content["bufferViews"][0]["byteStride"] = 4 * integers.itemsize
    made.content["accessors"][0] |= {"normalized": normalized, "type": "VEC3"}
    unit = 1 if normalized else limit
    made.node["scale"] = [size / (unit - low * unit / limit) for size in (0.02, 0.03, 0.05)]
    made.node["translation"] = [0, 0, 0] if low else [-0.01, -0.015, -0.025]
    assert_is(made.requires("KHR_mesh_quantization").glb(tmp_path / "a.glb"))


def test_the_least_normalized_integer_is_minus_one(tmp_path):
    made = Made(np.array([[-128, -127, 127]] * 3, "i1"), [0, 1, 2])
    made.content["accessors"][0]["normalized"] = True
    np.testing.assert_array_equal(read_gltf(made.glb(tmp_path / "a.glb"))[0][0], [-1, -1, 1])


@pytest.mark.parametrize("based", [True, False])
def test_sparse_accessors_are_read(tmp_path, based):
    """Some rows of an accessor are replaced; without a view the others are zero."""
    begun = CORNERS.copy() if based else np.zeros_like(CORNERS)
    rows = np.flatnonzero(CORNERS[:, 0] > 0) if based else np.arange(8)
    begun[rows] = 7
    made = Made(begun)
    made.content["accessors"][0]["sparse"] = {
        "count": len(rows),
        "indices": {"bufferView": made.view(rows.astype(np.uint16)), "componentType": 5123},
        "values": {"bufferView": made.view(CORNERS[rows])},
    }
    if not based:
        del made.content["accessors"][0]["bufferView"]
    assert_is(made.glb(tmp_path / "a.glb"))


@pytest.mark.parametrize("mirrored", [False, True])
def test_instances_are_placed_within_their_node(tmp_path, mirrored, rng):
    made = Made()
    where = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0]], np.float32)
    scale = np.array([[1, 1, 1], [1, -1, 1] if mirrored else [1, 2, 1], [0.5, 1, 2]], np.float32)
    turns = np.array(
        [[0, 0, 0, 32767], [0, 0, 32767, 0], [32767, 0, 0, 0]], np.int16
    )  # none, and half turns about z and x
    attributes = {"TRANSLATION": made.accessor(where), "SCALE": made.accessor(scale)}
    attributes["ROTATION"] = made.accessor(turns, normalized=True)
    made.node["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    T = transform(random_rotations(1, rng)[0], [0.01, 0.02, 0.03])
    made.node["matrix"] = T.T.ravel().tolist()
    signs = np.array([[1, 1, 1], [-1, -1, 1], [1, -1, -1]])
    corners = np.concatenate([CORNERS * s * sign + t for s, sign, t in zip(scale, signs, where, strict=True)])
    path = made.requires("EXT_mesh_gpu_instancing").glb(tmp_path / "a.glb")
    assert_is(path, apply(T, corners), VOLUME * np.abs(scale.prod(1)).sum(), bodies=3)


def test_nodes_place_scale_and_mirror_what_they_hold(tmp_path, rng):
    """Whatever affine maps a chain of nodes makes up, the outside stays outside."""
    for k in range(20):
        made = Made()
        A = np.tile(np.eye(4), (2, 1, 1))
        A[:, :3] += rng.normal(size=(2, 3, 4)) * [0.4, 0.4, 0.4, 0.05]
        made.content["nodes"] = [
            {"children": [1], "matrix": A[0].T.ravel().tolist()},
            {"children": [2], "scale": [-2, 1, 0.5], "rotation": [0, 0, 2**-0.5, 2**-0.5], "translation": [0, 0, 1]},
            {"mesh": 0, "matrix": A[1].T.ravel().tolist()},
        ]
        middle = np.array([[0, -1, 0, 0], [-2, 0, 0, 0], [0, 0, 0.5, 1], [0, 0, 0, 1]], float)
        T = A[0] @ middle @ A[1]
        found, faces = read_gltf(made.glb(tmp_path / f"{k}.glb"))
        np.testing.assert_allclose(found, apply(T, CORNERS.astype(float)), atol=1e-12)
        assert volume(found, faces) == pytest.approx(VOLUME * abs(np.linalg.det(T[:3, :3])), rel=1e-5)


def test_morph_targets_move_vertices_by_their_weights(tmp_path):
    made = Made()
    made.primitive["targets"] = [{"POSITION": made.accessor(CORNERS)}, {"NORMAL": made.accessor(CORNERS)}]
    assert_is(made.glb(tmp_path / "still.glb"))
    made.content["meshes"][0]["weights"] = [0.5, 1]
    assert_is(made.glb(tmp_path / "mesh.glb"), 1.5 * CORNERS, 1.5**3 * VOLUME)
    made.node["weights"] = [1, 0]
    assert_is(made.glb(tmp_path / "node.glb"), 2 * CORNERS, 8 * VOLUME)


def test_a_morph_target_without_data_moves_nothing(tmp_path):
    made = Made()
    still, half = made.accessor(CORNERS, bufferView=None), made.accessor(CORNERS)
    made.primitive["targets"] = [{"POSITION": still}, {"POSITION": half}]
    made.primitive["extensions"] = {"KHR_materials_variants": {"mappings": []}}
    made.node["weights"] = [1, 0.5]
    assert_is(made.glb(tmp_path / "a.glb"), 1.5 * CORNERS, 1.5**3 * VOLUME)
    made.content["accessors"][still]["extensions"] = {"ACME_packs": {}}
    refused("its mesh lies in the glTF extension .*ACME_packs", made.glb(tmp_path / "b.glb"))


def test_instances_that_differ_only_in_other_attributes_are_one(tmp_path):
    made = Made()
    attributes = {"_ID": made.accessor(np.arange(3, dtype=np.float32))}
    made.node["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    assert_is(made.glb(tmp_path / "a.glb"))


def test_strips_and_fans_are_triangles(tmp_path):
    """Two fans of a box's corners, about opposite ones, and the strip around a tetrahedron."""
    near = [0, 1, 5, 4, 6, 2, 3, 1]
    far = [7, 6, 4, 5, 1, 3, 2, 6]
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32) / 100
    made = Made(corners, near, mode=6)
    other = {**made.primitive, "indices": made.accessor(np.array(far, np.uint8))}
    made.content["meshes"][0]["primitives"].append(other)
    found, faces = read_gltf(made.glb(tmp_path / "fan.glb"))
    assert len(faces) == 12
    assert abs(volume(found, faces)) == pytest.approx(8e-6, rel=1e-6)
    tetrahedron = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32) / 100
    strip = Made(tetrahedron, [0, 2, 1, 3, 0, 2], mode=5)
    found, faces = read_gltf(strip.glb(tmp_path / "strip.glb"))
    assert volume(found, faces) == pytest.approx(1e-6 / 6, rel=1e-6)
    load_mesh(tmp_path / "strip.glb")


def test_faces_without_indices_take_vertices_in_their_order(tmp_path):
    assert_is(Made(CORNERS[FACES].reshape(-1, 3), None).glb(tmp_path / "a.glb"))


def test_points_and_lines_are_left_out(tmp_path):
    made = Made()
    made.content["meshes"][0]["primitives"] += [{**made.primitive, "mode": mode} for mode in (0, 1, 2, 3)]
    assert_is(made.glb(tmp_path / "a.glb"))
    del made.content["meshes"][0]["primitives"][0]
    refused("expected a surface of triangles, found only points or lines", made.glb(tmp_path / "b.glb"))


def test_the_default_scene_is_read(tmp_path):
    made = Made()
    made.content["nodes"] += [{"mesh": 0, "translation": [1, 0, 0]}, {"mesh": 0, "translation": [0, 1, 0]}]
    assert_is(made.glb(tmp_path / "one.glb"))
    made.content["scenes"].append({"nodes": [2]})
    assert_is(made.glb(tmp_path / "first.glb"))
    made.content["scene"] = 1
    assert_is(made.glb(tmp_path / "second.glb"), CORNERS + np.float32([0, 1, 0]))
    del made.content["scene"]
    refused("2 scenes and names none", made.glb(tmp_path / "none.glb"))
    del made.content["scenes"]
    assert len(read_gltf(made.glb(tmp_path / "nodes.glb"))[1]) == 36
    made.content["nodes"] = []
    refused("no scene that places them", made.glb(tmp_path / "meshes.glb"))
    made.content |= {"scenes": [{}], "scene": 0}
    refused("found nothing in the scene that it shows; export", made.glb(tmp_path / "empty.glb"))
    made.content |= {"scenes": [{"nodes": [0]}], "nodes": [{"camera": 0}, {"mesh": 0}]}
    refused("found nothing in the scene that it shows; export", made.glb(tmp_path / "camera.glb"))


def test_what_moves_bends_or_hides_the_mesh_is_named(tmp_path):
    made = Made()
    made.content["nodes"] = [{"children": [1], "name": "arm"}, {"mesh": 0, "name": "hand"}]
    made.content["animations"] = [
        {"channels": [{"sampler": 0, "target": {"node": 0, "path": "rotation"}}], "samplers": []}
    ]
    refused("node 'hand': an animation moves it", made.glb(tmp_path / "a.glb"))
    pointer = {"KHR_animation_pointer": {"pointer": "/nodes/1/scale"}}
    made.content["animations"][0]["channels"][0]["target"] = {"path": "pointer", "extensions": pointer}
    refused("node 'hand': an animation moves it", made.glb(tmp_path / "b.glb"))
    made.content["nodes"].append({"camera": 0})
    made.content["animations"][0]["channels"][0]["target"] = {"node": 2, "path": "rotation"}
    assert_is(made.glb(tmp_path / "camera.glb"))
    made.content["nodes"][0]["extensions"] = {"KHR_node_visibility": {"visible": False}}
    refused("node 'hand': it is hidden by the glTF extension KHR_node_visibility", made.glb(tmp_path / "c.glb"))
    made.content["nodes"][:2] = [{"children": [1]}, {"mesh": 0, "skin": 0}]
    refused("node 1: a skin poses it", made.glb(tmp_path / "d.glb"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c["nodes"][0].update(children=[0]), "node 0 is in the scene twice, or in a circle"),
        (lambda c: c["nodes"][0].update(matrix=[1.0] * 16), "no affine map"),
        (lambda c: c["nodes"][0].update(mesh=-1), "names number -1 of 1 meshes"),
        (lambda c: c["nodes"][0].update(rotation=[0, 0, 0, 0]), "no valid glTF 2.0"),
        (lambda c: c["accessors"][0].update(count=9), "reaches beyond its view"),
        (lambda c: c["accessors"][1].update(count=35), "35 corners, no multiple of three"),
        (lambda c: c["accessors"][0].update(count=7), "names a vertex that is not there .of 7."),
        (lambda c: c["accessors"][0].update(componentType=5130), "component type 5130"),
        (lambda c: c["accessors"][0].update(type="VEC2"), "expected VEC3, got VEC2"),
        (lambda c: c["bufferViews"][1].update(byteLength=400), "reaches beyond its buffer"),
        (lambda c: c["meshes"][0]["primitives"][0].update(mode=7), "mode 7"),
        (lambda c: c["meshes"][0]["primitives"][0].update(attributes={}), "no positions"),
        (lambda c: c["asset"].update(version="1.0"), "expected glTF 2.0, got version 1.0"),
        (lambda c: c.update(scene=3), "names number 3 of 1 scenes"),
        (lambda c: c.pop("asset"), "no valid glTF 2.0 .KeyError: 'asset'"),
        (lambda c: c.update(nodes={"a": 1}), "no valid glTF 2.0"),
    ],
)
def test_what_is_no_gltf_is_refused(tmp_path, change, words):
    made = Made()
    change(made.content)
    refused(words, made.glb(tmp_path / "a.glb"))


def test_a_truncated_or_old_file_is_named_as_such(tmp_path):
    whole = Made().glb(tmp_path / "a.glb").read_bytes()
    (tmp_path / "a.glb").write_bytes(whole[:-1])
    refused(f"is cut short: expected {len(whole):,} bytes, found {len(whole) - 1:,}", tmp_path / "a.glb")
    (tmp_path / "a.glb").write_bytes(whole + b"more")
    assert_is(tmp_path / "a.glb")
    (tmp_path / "a.glb").write_bytes(whole[:4] + b"\1" + whole[5:])
    refused("expected glTF 2.0, got version 1", tmp_path / "a.glb")


def test_files_of_other_programs_give_the_same_surface(tmp_path):
    scene = trimesh.Scene([BOX, BOX.copy().apply_translation((0.1, 0, 0))])
    for name in ("a.glb", "a.gltf"):
        scene.export(str(tmp_path / name))
        found, faces = read_gltf(tmp_path / name)
        assert volume(found, faces) == pytest.approx(2 * VOLUME, rel=1e-6)


def test_the_shared_samples(data_folder):
    inputs = data_folder / "inputs"
    refused("KHR_draco_mesh_compression", inputs / "draco_one_of_two.glb")
    low, high = [-0.008, -0.006, -0.001], [0.014, 0.008, 0.012]
    for name, within in (("quant_norm.glb", 0.022 / 2**16), ("m2.gltf", 1e-8)):
        vertices = load_mesh(inputs / name).vertices
        np.testing.assert_allclose([vertices.min(0), vertices.max(0)], [low, high], atol=within)


def test_preparation_reads_and_refuses_as_loading_does(tmp_path, monkeypatch):
    pytest.importorskip("pymeshlab")
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "tools"))
    from meshprep.reading import read

    from geomtact.sensing.sensor import Sensor

    made = Made()
    made.node["scale"] = [-1, 1, 1]
    surface, unit = read(made.glb(tmp_path / "a.glb"), None, Sensor.load("gelslim"))
    assert (unit, surface.volume) == ("m", pytest.approx(VOLUME, rel=1e-5))
    with pytest.raises(MeshError, match="needs the glTF extension ACME_bends_meshes"):
        read(made.requires("ACME_bends_meshes").glb(tmp_path / "b.glb"), None, Sensor.load("gelslim"))
