"""Loading a mesh: the object frame stays, the same surface is the same mesh, and what cannot be used is refused in one line."""

import numpy as np
import pytest
import trimesh

from geomtact.errors import MeshError
from geomtact.geometry.catalogue import catalogue
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.mesh_file import UNITS, load_mesh
from geomtact.se3 import apply, random_rotations, transform
from geomtact.sensing.sensor import Sensor

SENSORS = ("gelslim", "gelsight-mini")


def box(extents=(20.0, 30.0, 50.0), offset=(7.0, -3.0, 100.0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation(offset)
    return mesh


def save(mesh, path):
    mesh.export(str(path))
    return path


def refused(match: str, *args, **kwargs) -> None:
    with pytest.raises(MeshError, match=match) as caught:
        load_mesh(*args, **kwargs)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off"])
@pytest.mark.parametrize("unit", UNITS)
def test_coordinates_are_the_file_s_own_in_metres(tmp_path, suffix, unit):
    mesh = load_mesh(save(box(), tmp_path / f"a.{suffix}"), unit)
    expected = np.unique(box().vertices, axis=0) * UNITS[unit]
    np.testing.assert_allclose(mesh.vertices, expected, rtol=6e-8, atol=0)
    assert (mesh.name, mesh.unit, len(mesh.faces)) == ("a", unit, 12)


def test_a_face_keeps_its_outside(tmp_path):
    mesh = load_mesh(save(box(), tmp_path / "a.stl"), "mm")
    middle = mesh.vertices[mesh.faces].mean(1)
    assert (((middle - mesh.centre) * mesh.normals).sum(1) > 0).all()
    assert mesh.areas.sum() == pytest.approx(2e-6 * (20 * 30 + 30 * 50 + 50 * 20), rel=1e-6)


@pytest.mark.parametrize("name", ["bracket", "gear", "pin"])
def test_mm_stl_and_metre_glb_of_one_object_are_one_mesh(tmp_path, name):
    original = load_mesh(name)
    raw = trimesh.load_mesh(str(original.path), process=False)
    raw.apply_scale(1e-3)
    glb = load_mesh(save(raw, tmp_path / "a.glb"))
    np.testing.assert_array_equal(glb.vertices, original.vertices)
    assert glb.sha256 == original.sha256


def test_hash_ignores_order_and_name_but_not_shape(tmp_path, rng):
    mesh = box()
    shuffled = rng.permutation(len(mesh.vertices))
    faces = np.argsort(shuffled)[mesh.faces][rng.permutation(len(mesh.faces))]
    other = trimesh.Trimesh(mesh.vertices[shuffled], np.roll(faces, 1, axis=1), process=False)
    one = load_mesh(save(mesh, tmp_path / "one.ply"), "mm")
    assert one.sha256 == load_mesh(save(other, tmp_path / "two.off"), "mm").sha256
    assert one.sha256 != load_mesh(tmp_path / "one.ply", "cm").sha256
    assert one.sha256 != load_mesh(save(box((20, 30, 50.01)), tmp_path / "three.stl"), "mm").sha256


def test_scene_is_placed_and_concatenated(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((0.02, 0.02, 0.02)), transform=transform(np.eye(3), [0, 0, 0.1]))
    mirror = np.diag([-1.0, 1, 1, 1])
    mirror[0, 3] = 0.05
    scene.add_geometry(trimesh.creation.box((0.01, 0.01, 0.03)), transform=mirror)
    mesh = load_mesh(save(scene, tmp_path / "two.glb"))
    assert len(mesh.faces) == 24
    np.testing.assert_allclose(mesh.vertices.min(0), [-0.01, -0.01, -0.015], atol=1e-8)
    np.testing.assert_allclose(mesh.vertices.max(0), [0.055, 0.01, 0.11], atol=1e-8)


def test_a_cavity_is_no_inverted_body(tmp_path):
    hole = trimesh.creation.box((5, 5, 5))
    hole.invert()
    assert (
        len(load_mesh(save(trimesh.util.concatenate([box(offset=(0, 0, 0)), hole]), tmp_path / "a.ply"), "mm").faces)
        == 24
    )
    hole.apply_translation((100, 0, 0))
    refused("inside out", save(trimesh.util.concatenate([box(), hole]), tmp_path / "b.ply"), "mm")


def u_block() -> trimesh.Trimesh:
    """A U of 30 x 20 x 10, open towards +y between x = -5 and 5."""
    ring = [(-15, -10), (15, -10), (15, 10), (5, 10), (5, 0), (-5, 0), (-5, 10), (-15, 10)]
    n = len(ring)
    vertices = [(x, y, z) for z in (-5, 5) for x, y in ring]
    walls = [f for k in range(n) for f in ((k, (k + 1) % n, n + (k + 1) % n), (k, n + (k + 1) % n, n + k))]
    cap = np.array([(0, 1, 5), (1, 4, 5), (1, 2, 4), (2, 3, 4), (0, 5, 6), (0, 6, 7)])
    return trimesh.Trimesh(vertices, [*walls, *cap[:, ::-1], *(cap + n)], process=False)


def inverted(mesh) -> trimesh.Trimesh:
    mesh.invert()
    return mesh


@pytest.mark.parametrize("turned", [False, True])
def test_a_cavity_lies_in_a_body_and_not_only_within_its_bounds(tmp_path, turned, rng):
    T = transform(random_rotations(1, rng)[0], [3, 1, 2]) if turned else np.eye(4)

    def saved(*bodies):
        return save(trimesh.util.concatenate(bodies).apply_transform(T), tmp_path / "a.ply")

    u = u_block()
    assert u.is_volume and u.volume == pytest.approx(10 * (600 - 100))
    for size, where in (
        ((4, 4, 4), (10, 0, 0)),
        ((4, 4, 4), (0, -5, 0)),
        ((20, 4, 4), (0, -5, 0)),
        ((9, 4, 10), (0, -5, 0)),
    ):
        assert len(load_mesh(saved(u, inverted(box(size, where))), "mm").faces) == 28 + 12
    assert len(load_mesh(saved(u, box((4, 4, 4), (0, 6, 0))), "mm").faces) == 28 + 12
    for where in ((0, 6, 0), (0, 2.5, 1), (2.9, 7.9, -2.9)):  # a pin in the mouth
        refused("inside out", saved(u, inverted(box((4, 4, 4), where))), "mm")
    refused(
        "a body about .* mm, whose faces look inwards, passes through another; subtract it in CAD",
        saved(u, inverted(box((20, 4, 4), (0, 6, 0)))),
        "mm",
    )


def test_a_sheet_beside_a_body_encloses_no_volume(tmp_path, rng):
    for points in (rng.uniform(-9, 9, (3, 3)) for _ in range(10)):
        for faces in ([[0, 1, 2], [0, 2, 1]], [[0, 2, 1], [0, 1, 2]]):
            sheet = trimesh.Trimesh(points + [40, 0, 0], faces, process=False)
            both = save(trimesh.util.concatenate([box(), sheet]), tmp_path / "a.ply")
            refused("a body about .* mm encloses no volume, as a sheet without thickness; remove it", both, "mm")
    n = 12  # a wavy one of many faces
    k = np.arange(n * n).reshape(n, n)[:-1, :-1].ravel()
    x, y = np.divmod(np.arange(n * n), n)
    side = np.concatenate([np.stack([k, k + n, k + n + 1], 1), np.stack([k, k + n + 1, k + 1], 1)])
    wave = trimesh.Trimesh(np.stack([x, y, 40 + np.sin(x) + np.cos(y)], 1), [*side, *side[:, ::-1]], process=False)
    refused("encloses no volume, as a sheet", save(trimesh.util.concatenate([box(), wave]), tmp_path / "b.ply"), "mm")
    needle = box((0.002, 0.002, 50), (40, 0, 0))
    assert len(load_mesh(save(trimesh.util.concatenate([box(), needle]), tmp_path / "c.ply"), "mm").faces) == 24


def test_diameter_is_the_largest_distance(rng):
    points = rng.normal(size=(300, 3))
    hull = trimesh.convex.convex_hull(points)
    mesh = Mesh(hull.vertices, hull.faces, "hull", "m")
    assert mesh.diameter == pytest.approx(np.linalg.norm(points[:, None] - points, axis=-1).max(), abs=1e-12)
    assert load_mesh("ball").diameter == pytest.approx(0.012, abs=2e-8)


def test_radius_rms_is_that_of_the_samples_and_samples_lie_on_the_surface():
    mesh = load_mesh("stepped_shaft")
    points, normals = mesh.sample_surface(50_000, seed=3)
    assert mesh.radius_rms == pytest.approx(np.sqrt(((points - mesh.centre) ** 2).sum(1).mean()), rel=0.01)
    np.testing.assert_array_equal(points, mesh.surface_points(50_000, seed=3))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    raw = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    inside = raw.ray.contains_points(points[:300] - 1e-5 * normals[:300])
    outside = raw.ray.contains_points(points[:300] + 1e-5 * normals[:300])
    assert inside.mean() > 0.98
    assert outside.mean() < 0.02
    assert load_mesh("ball").radius_rms == pytest.approx(0.006, rel=1e-3)


def test_diameter_and_radius_do_not_depend_on_the_frame(rng):
    mesh = load_mesh("bracket").with_symmetry()
    T = transform(random_rotations(1, rng)[0], [0.01, 0.02, 0.03])
    moved = Mesh(apply(T, mesh.vertices), mesh.faces, "moved", "m")
    assert moved.diameter == pytest.approx(mesh.diameter, rel=1e-12)
    assert moved.areas.sum() == pytest.approx(mesh.areas.sum(), rel=1e-12)


def test_arrays_cannot_be_written():
    with pytest.raises(ValueError, match="read-only"):
        load_mesh("ball").vertices[0] = 0


def test_unit_is_never_guessed(tmp_path):
    stl = save(box(), tmp_path / "a.stl")
    refused("mm, cm, m or inch", stl)
    refused("unknown unit 'km'", stl, "km")
    refused("metres by definition.*re-export it in metres, or save it as STL", save(box(), tmp_path / "a.glb"), "mm")
    refused("unit is likely wrong; .*re-export it in metres", tmp_path / "a.glb", sensor=Sensor.load("gelslim"))
    assert load_mesh(stl, "MM").sha256 == load_mesh(stl, "mm").sha256
    refused("catalogue.s unit is mm", "pin", "m")
    assert load_mesh(catalogue()["pin"].file).sha256 == load_mesh("pin").sha256


def test_unknown_names_and_files(tmp_path):
    refused("did you mean 'elbow_pipe'", "elbow-pipe")
    refused("did you mean 'pin'", "PIN")
    refused("no object named 'zzz'", "zzz")
    refused("no such file; give", tmp_path / "nothing.stl", "mm")
    save(box(), tmp_path / "part.stl")
    refused(r"prat.stl: no such file; did you mean 'part.stl'\?$", tmp_path / "prat.stl")
    refused("no such file; give the path", tmp_path / "open.stl")
    (tmp_path / "a.step").write_text("ISO-10303-21;")
    refused("make a mesh of it with 'python tools/prep_mesh.py a.step'", tmp_path / "a.step", "mm")
    refused("no such file; give", tmp_path / "b.stp", "mm")
    (tmp_path / "a.txt").write_text("x")
    refused("not a mesh format", tmp_path / "a.txt", "mm")


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "glb", "gltf"])
@pytest.mark.parametrize(
    "content", [b"", b"\x00" * 100, b"solid nothing\nendsolid\n", b"ply\n", b"\xff\xfe rubbish \n 1 2 3"]
)
def test_broken_files(tmp_path, suffix, content):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(content)
    refused(str(path), path, None if suffix.startswith("gl") else "mm")


@pytest.mark.parametrize("suffix", ["stl", "ply", "glb"])
def test_truncated_files(tmp_path, suffix):
    path = save(box(), tmp_path / f"a.{suffix}")
    path.write_bytes(path.read_bytes()[:-40])
    refused("a.", path, None if suffix == "glb" else "mm")


def test_points_nan_and_open_surfaces(tmp_path):
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    refused("only points", tmp_path / "points.obj", "mm")
    nan = box()
    vertices = np.array(nan.vertices)
    vertices[3, 1] = np.nan
    refused("NaN", save(trimesh.Trimesh(vertices, nan.faces, process=False), tmp_path / "nan.stl"), "mm")
    mesh = box()
    refused(
        r"3 of 18 edges are open.*mesh editor",
        save(trimesh.Trimesh(mesh.vertices, mesh.faces[1:], process=False), tmp_path / "open.stl"),
        "mm",
    )
    faces = np.array(mesh.faces)
    faces[0] = faces[0, ::-1]
    refused("disagree", save(trimesh.Trimesh(mesh.vertices, faces, process=False), tmp_path / "turned.ply"), "mm")
    mesh.invert()
    refused("inside out", save(mesh, tmp_path / "inverted.stl"), "mm")
    sheet = trimesh.Trimesh([[0, 0, 0], [9, 0, 0], [0, 9, 0]], [[0, 1, 2], [0, 2, 1]], process=False)
    refused("no volume", save(sheet, tmp_path / "sheet.ply"), "mm")


def test_a_truncated_file_is_named_as_such(tmp_path):
    whole = save(box(), tmp_path / "whole.stl").read_bytes()
    cut = tmp_path / "cut.stl"
    cut.write_bytes(whole[: 84 + 50 * 5])
    refused(f"cut short: expected {len(whole)} bytes .*, found 334", cut, "mm")


def test_inches_for_millimetres_are_refused(tmp_path):
    sensor = Sensor.load("gelsight-mini")
    path = save(box((60, 40, 30)), tmp_path / "part.stl")
    assert load_mesh(path, "mm", sensor=sensor).diameter < 0.1
    refused("unit is likely wrong", path, "inch", sensor=sensor)
    refused("expected a geomtact.Sensor, got 'gelsight-mini'", path, "mm", sensor="gelsight-mini")


@pytest.mark.parametrize("sensor", SENSORS)
def test_a_unit_1000_times_wrong_is_refused_and_the_right_one_is_not(tmp_path, sensor):
    sensor = Sensor.load(sensor)
    for name, entry in catalogue().items():
        mesh = load_mesh(name, sensor=sensor)
        if mesh.diameter > 0.011:
            refused("unit is likely wrong", _copy(entry.file, tmp_path), "m", sensor=sensor)
        metres = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        refused("unit is likely wrong", save(metres, tmp_path / "small.ply"), "mm", sensor=sensor)
    with pytest.raises(MeshError, match="unit is likely wrong"):
        load_mesh(Mesh(1e3 * mesh.vertices, mesh.faces, "big", "m"), sensor=sensor)


@pytest.mark.parametrize(
    ("scale", "size"),
    [
        (1e-3, "0.0616 mm across"),
        (1e-6, "less than 0.001 mm across"),
        (1e7, r"616,441,\d{3} mm across"),
        (1e30, "more than 1,000,000,000"),
    ],
)
def test_sizes_are_printed_in_millimetres_without_exponents(tmp_path, scale, size):
    with pytest.raises(MeshError, match=size) as caught:
        load_mesh(save(box(offset=(0, 0, 0)).apply_scale(scale), tmp_path / "a.ply"), "mm")
    assert "expected 0.1 mm to 1,000,000 mm" in str(caught.value)
    assert "e-" not in str(caught.value).removeprefix(str(tmp_path))


def _copy(path, folder):
    copy = folder / path.name
    copy.write_bytes(path.read_bytes())
    return copy


def test_dirty_files_raise_mesh_errors_only(data_folder):
    loaded = 0
    for path in sorted(data_folder.glob("meshes_*dirty/*")) + sorted(data_folder.glob("meshes_trimesh/dirty/*")):
        if path.suffix == ".txt":
            continue
        try:
            load_mesh(path, "mm")
            loaded += 1
        except MeshError as error:
            assert "\n" not in str(error)
            assert path.name in str(error)
    assert loaded >= 10


@pytest.mark.parametrize(
    ("pattern", "unit"),
    [
        ("meshes_small_solids/*.stl", "mm"),
        ("meshes_ycb/*.obj", "cm"),
        ("hsp_digit_sim_ycb/meshes/*.obj", "m"),
        ("meshes_factory_nist/*peg*.obj", "m"),
        ("meshes_trimesh/clean/featuretype.STL", "inch"),
        ("meshes_trimesh/clean/octagonal_pocket.stl", "m"),
        ("meshes_trimesh/clean/[a-r]*.STL", "inch"),
    ],
)
def test_real_objects_load(data_folder, pattern, unit):
    paths = sorted(data_folder.glob(pattern))
    assert paths
    for path in paths:
        mesh = load_mesh(path, unit)
        raw = trimesh.load_mesh(str(path))
        np.testing.assert_allclose(mesh.vertices.min(0), UNITS[unit] * raw.bounds[0], atol=1e-7 * mesh.diameter)
        np.testing.assert_allclose(mesh.vertices.max(0), UNITS[unit] * raw.bounds[1], atol=1e-7 * mesh.diameter)


def test_a_nut_with_open_edges_is_refused(data_folder):
    refused("108 of .* edges are open", data_folder / "meshes_factory_nist/factory_nut_m16_tight_subdiv_3x.obj", "m")
