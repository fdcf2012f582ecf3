"""Mesh preparation: what is sound stays to the last bit, what is spoilt comes back, and what moves is measured and refused."""

import io
import json
import sys
import tomllib
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer import Typer
from typer.testing import CliRunner

from geomtact import Effort, Localizer, Sensor, load_mesh, se3
from geomtact.errors import MeshError
from geomtact.geometry import catalogue as catalogues
from geomtact.geometry.distance import PoseDistance
from geomtact.geometry.polygons import Polygons

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))

import prep_mesh  # noqa: E402
from meshprep import Refused  # noqa: E402
from meshprep.adding import add  # noqa: E402
from meshprep.polygons import distance, points_on  # noqa: E402
from meshprep.proof import _distance as distances_from  # noqa: E402
from meshprep.proof import distances, prove  # noqa: E402
from meshprep.reading import TESSELLATION, read  # noqa: E402
from meshprep.repair import STEPS, Options, Work, repair  # noqa: E402
from meshprep.surface import Surface  # noqa: E402
from meshprep.writing import write_ply  # noqa: E402
from step_files import cylinder_step, solid_step  # noqa: E402

BOX = trimesh.creation.box((10.0, 8.0, 6.0))


def options(surface, **other):
    given = {
        "skip": frozenset(),
        "merge": 1e-6 * surface.size,
        "max_hole": 3.0,
        "max_faces": 200_000,
        "max_error": 0.025,
    }
    return Options(**(given | other))


def as_surface(mesh):
    return Surface(np.array(mesh.vertices, float), np.array(mesh.faces, np.int64))


def sound(surface, folder):
    """The file of a surface, which trimesh and geomtact find closed."""
    path = folder / "mesh.ply"
    write_ply(path, surface, "mm")
    mesh = trimesh.load_mesh(path)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.is_volume and mesh.volume > 0
    return load_mesh(path, "mm")


@pytest.fixture(scope="module")
def command():
    app = Typer()
    app.command()(prep_mesh.main)
    return lambda *args: CliRunner().invoke(app, [str(arg) for arg in args])


@pytest.fixture
def here(command, monkeypatch):
    """The command, which prepares meshes in this process: starting another takes a second each."""
    monkeypatch.setattr(prep_mesh, "_bounded", lambda *each: prep_mesh.prepare(*each) | {"seconds": 0.0})
    return command


@pytest.mark.parametrize("name", ["bracket", "gear", "pin"])
def test_a_sound_mesh_is_kept_to_the_last_bit(name, tmp_path):
    before, unit = read(ROOT / "meshes" / f"{name}.stl", "mm", Sensor.load("gelslim"))
    work = repair(before, options(before))
    assert unit == "mm" and not work.changes and not work.holes
    proof = prove(before, work)
    assert (proof.new, proof.largest, proof.buried) == (0, pytest.approx(0, abs=1e-6 * before.size), 0)
    assert sound(work.surface, tmp_path).sha256 == load_mesh(name).sha256


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**32 - 1),
    turned=st.floats(0.01, 0.5),
    repeated=st.floats(0.0, 0.3),
    name=st.sampled_from(["hex_nut", "bracket"]),
    scale=st.floats(0.2, 5.0),
)
def test_shuffled_repeated_turned_and_torn_apart_it_comes_back(seed, turned, repeated, name, scale, tmp_path):
    """In any pose and size, with its faces in any order, some stored twice or inside out, each with separate corners."""
    rng = np.random.default_rng(seed)
    mesh = load_mesh(name)
    T = se3.transform(se3.random_rotations(1, rng)[0], rng.uniform(-50, 50, 3))
    vertices = se3.apply(T, 1e3 * scale * mesh.vertices).astype(np.float32).astype(float)
    path = tmp_path / "sound.ply"
    write_ply(path, Surface(vertices, mesh.faces.astype(np.int64)), "mm")
    faces = rng.permutation(mesh.faces.astype(np.int64))
    faces = np.concatenate([faces, faces[rng.random(len(faces)) < repeated]])
    flip = rng.random(len(faces)) < turned
    faces[flip] = faces[flip][:, ::-1]
    soup = Surface(vertices[faces.ravel()], np.arange(3 * len(faces)).reshape(-1, 3))
    work = repair(soup, options(soup))
    assert sound(work.surface, tmp_path).sha256 == load_mesh(path, "mm").sha256


def test_a_hole_is_filled_and_reported_or_refused_with_its_position():
    ball = trimesh.creation.icosphere(4, 10.0)
    gone = np.linalg.norm(ball.triangles_center - [0, 0, 10.0], axis=1) < 0.9
    holed = as_surface(ball).with_faces(as_surface(ball).faces[~gone]).tidied()
    work = repair(holed, options(holed))
    (hole,) = work.holes
    assert 2 < hole.span < 3 and 0.4 < hole.area / (np.pi / 4 * hole.span**2) < 1
    np.testing.assert_allclose(hole.middle, [0, 0, 9.9], atol=0.2)
    assert not work.surface.open_edges and work.surface.volume == pytest.approx(ball.volume, rel=1e-3)
    # what fills the hole is not held against the surface
    assert prove(holed, work).largest < 1e-6
    with pytest.raises(
        Refused, match=r"a hole 2\..* across at \(.*, 9\..*\), the widest of 1, is wider than 1 .*; close it in CAD"
    ):
        repair(holed, options(holed, max_hole=1.0))
    skipped = repair(holed, options(holed, skip=frozenset(["holes"])))
    assert skipped.surface.open_edges and not skipped.holes


def test_sides_of_a_seam_that_are_cut_up_differently_meet(tmp_path):
    """A box whose lid has its edges divided, and whose walls do not."""
    lid = BOX.triangles_center[:, 2] > 2.9
    finer = BOX.submesh([np.flatnonzero(lid)], append=True).subdivide().subdivide()
    rest = BOX.submesh([np.flatnonzero(~lid)], append=True)
    torn = as_surface(trimesh.util.concatenate([finer, rest]))
    work = repair(torn, options(torn))
    assert "seams" in work.changes and not work.holes
    assert prove(torn, work).largest < 1e-6 * torn.size
    sound(work.surface, tmp_path)
    assert work.surface.volume == pytest.approx(480)


def test_boxes_that_share_an_edge_stay_apart_in_any_file(tmp_path):
    other = BOX.copy()
    other.apply_translation([10.0, 8.0, 0.0])
    both = as_surface(trimesh.util.concatenate([BOX, other]))
    work = repair(both, options(both))
    assert {"cut", "apart"} <= set(work.changes)
    assert 0 < prove(both, work).largest < 1e-4
    assert sound(work.surface, tmp_path)
    assert work.surface.volume == pytest.approx(960, rel=1e-4)


def test_bodies_that_overlap_become_their_union(tmp_path):
    other = BOX.copy()
    other.apply_translation([5.0, 4.0, 3.0])
    both = as_surface(trimesh.util.concatenate([BOX, other]))
    work = repair(both, options(both))
    assert "intersections" in work.changes
    assert work.surface.volume == pytest.approx(2 * 480 - 5 * 4 * 3, rel=1e-6)
    proof = prove(both, work)
    # what lay inside is no deviation, for nobody can touch it
    assert proof.largest < 1e-5 * both.size and 0.1 < proof.buried < 0.3
    sound(work.surface, tmp_path)


def test_a_sheet_of_no_thickness_goes_and_a_cavity_stays(tmp_path):
    cavity = trimesh.creation.box((2.0, 2.0, 2.0))
    cavity.invert()
    hollow = trimesh.util.concatenate([BOX, cavity])
    vertices = np.concatenate([hollow.vertices, [[5.0, 4.0, 12.0]]])
    corner = [int(np.flatnonzero((hollow.vertices == c).all(1))[0]) for c in ([5, 4, 3], [5, -4, 3])]
    flap = [[*corner, len(vertices) - 1], [*corner[::-1], len(vertices) - 1]]
    spoilt = Surface(np.array(vertices), np.concatenate([hollow.faces, flap]).astype(np.int64))
    work = repair(spoilt, options(spoilt))
    assert work.surface.volume == pytest.approx(480 - 8) and len(work.surface.volumes) == 2
    sound(work.surface, tmp_path)


@pytest.mark.slow
def test_the_largest_body_alone_and_specks():
    speck = trimesh.creation.box((1e-3, 1e-3, 1e-3))
    speck.apply_translation([20, 0, 0])
    small = trimesh.creation.box((2.0, 2.0, 2.0))
    small.apply_translation([-20, 0, 0])
    three = as_surface(trimesh.util.concatenate([BOX, speck, small]))
    work = repair(three, options(three))
    assert work.surface.volume == pytest.approx(488) and work.changes["bodies"] == "1 of 3 bodies dropped"
    assert repair(three, options(three, largest=True)).surface.volume == pytest.approx(480)
    assert prove(three, work).largest < 1e-6 * three.size


def box(size, where=(0.0, 0.0, 0.0), inwards=False):
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(where)
    if inwards:
        mesh.invert()
    return mesh


HOLLOW = trimesh.util.concatenate([box((20, 20, 20)), box((10, 10, 9), inwards=True)])


def test_a_cavity_stays_one_however_the_file_is_wound(rng, tmp_path):
    inside_out = HOLLOW.copy()
    inside_out.invert()
    torn = as_surface(HOLLOW)
    faces = torn.faces.copy()
    flip = rng.random(len(faces)) < 0.4
    faces[flip] = faces[flip][:, ::-1]
    for surface in (as_surface(HOLLOW), as_surface(inside_out), torn.with_faces(faces)):
        work = repair(surface, options(surface))
        assert work.surface.volume == pytest.approx(7100) and len(work.surface.volumes) == 2
        assert repair(surface, options(surface, largest=True)).surface.volume == pytest.approx(7100)
        sound(work.surface, tmp_path)


def test_a_body_only_within_anothers_bounds_is_no_cavity(tmp_path):
    slug = box((4, 4, 3), (1, 0, 0), inwards=True)
    ring = trimesh.creation.annulus(10, 15, 6)
    surface = as_surface(trimesh.util.concatenate([ring, slug]))
    work = repair(surface, options(surface))
    assert work.changes["winding"].startswith("12 of") and work.surface.volume == pytest.approx(ring.volume + 48)
    drill = trimesh.creation.cylinder(3, 12)
    drill.apply_translation([0.3, 0.2, 8])
    drill.invert()
    drilled = as_surface(trimesh.util.concatenate([box((20, 20, 20)), drill]))
    with pytest.raises(Refused, match="wound inwards, about .* passes through another; subtract it in CAD"):
        repair(drilled, options(drilled))


def test_two_rims_that_lie_on_each_other_are_a_seam_and_no_hole(tmp_path):
    ring = trimesh.creation.annulus(2, 8, 6, sections=32)
    wall = (np.abs(ring.face_normals[:, 2]) < 0.1) & (np.hypot(*ring.triangles_center.T[:2]) < 2.5)
    corners = ring.triangles.copy()
    corners[wall] *= [0.999, 0.999, 1]
    gaping = Surface(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3))
    with pytest.raises(Refused, match="two rims lie 0.002 apart .* a seam, not a hole; join them with --merge 0.003"):
        repair(gaping, options(gaping, max_hole=5.0))
    work = repair(gaping, options(gaping, merge=0.003))
    assert not work.holes and work.surface.volume == pytest.approx(ring.volume, rel=1e-2)
    assert prove(gaping, work).largest < 2.1e-3
    sound(work.surface, tmp_path)


@pytest.mark.parametrize(
    ("size", "where", "volume"), [((10, 10, 10), (10, 0, 0), 2000), ((20, 10, 10), (15, 0, 0), 3000)]
)
def test_boxes_that_share_a_face_are_one_solid_or_two(size, where, volume, tmp_path):
    both = as_surface(trimesh.util.concatenate([box((10, 10, 10)), box(size, where)]))
    work = repair(both, options(both))
    assert not work.surface.crowded_edges and work.surface.volume == pytest.approx(volume, rel=1e-3)
    assert prove(both, work).largest < 1e-3
    sound(work.surface, tmp_path)


@pytest.mark.parametrize(
    ("faces", "words"),
    [([[0, 1, 2], [0, 2, 1]], "enclose nothing"), ([[0, 1, 3], [1, 0, 3]], "enclose nothing|no face has any area")],
)
def test_a_surface_that_encloses_nothing_is_refused(faces, words):
    vertices = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [5, 0, 0]])
    nothing = Surface(vertices, np.array(faces))
    with pytest.raises(Refused, match=words):
        repair(nothing, options(nothing))


def test_a_mesh_of_too_many_faces_is_made_coarser_within_the_bound():
    ball = as_surface(trimesh.creation.icosphere(5, 10.0))
    work = repair(ball, options(ball, max_faces=6000, max_error=0.02))
    assert len(work.surface.faces) < len(ball.faces) and not work.surface.open_edges
    assert max(distances(ball, work.surface).max(), distances(work.surface, ball).max()) <= 0.02
    # what would move it farther is not done
    assert len(repair(ball, options(ball, max_faces=100, max_error=1e-6)).surface.faces) == len(ball.faces)


def test_a_surface_that_moved_is_measured_both_ways():
    box = as_surface(BOX)
    moved = Surface(box.vertices + [0.0, 0.0, 0.3], box.faces)
    proof = prove(box, Work(moved))
    assert proof.to_input[0] == pytest.approx(0.3, abs=1e-6)
    # the lid of the original now lies inside, its floor and walls do not
    assert proof.to_output[0] == pytest.approx(0.3, abs=1e-6) and abs(proof.worst[2]) >= 3 - 1e-6
    assert proof.new == len(box.vertices)


def test_steps_can_be_left_out(here, tmp_path):
    path = tmp_path / "box.stl"
    BOX.export(path)
    done = here(path, "--unit", "mm", "--out", tmp_path / "out", *(x for s in STEPS for x in ("--skip", s)))
    assert done.exit_code == 0, done.output
    report = json.loads((tmp_path / "out" / "box.json").read_text("utf-8"))
    assert report["outcome"] == "clean" and report["options"]["skip"] == sorted(STEPS)
    wrong = here(path, "--unit", "mm", "--skip", "mend")
    assert wrong.exit_code == 2 and "no step named mend" in wrong.output


def prepared(file, unit, folder):
    """A localizer of what becomes of a file, on a grid of some 3,000 poses."""
    surface, own = read(file, unit, Sensor.load("gelslim"))
    path = folder / f"{file.name}.ply"
    write_ply(path, repair(surface, options(surface)).surface, own)
    return Localizer.prepare(path, unit=own, sensor="gelslim", max_poses=3_000, cache_dir=folder / "cache")


def apart(a, b, mask):
    """How far apart [mm] two localizers' first modes are, in mean point distance, modulo the object's symmetry: by the cells,
    because particles are drawn anew where a mesh differs by a rounding."""
    one, other = (each.localize(mask, "mask", effort=Effort(5)).modes(1)[0].T for each in (a, b))
    return 1e3 * PoseDistance(a.mesh).mean(one, other[None])[0]


@pytest.mark.slow
def test_the_same_object_in_any_format_and_unit_has_the_same_posterior(few_touches, tmp_path, rng):
    mesh = load_mesh("bracket")
    for file, scale in {"mm.stl": 1e3, "metre.glb": 1.0, "inch.obj": 1 / 25.4e-3}.items():
        trimesh.Trimesh(scale * mesh.vertices, mesh.faces, process=False).export(tmp_path / file)
    (tmp_path / "part.step").write_text(solid_step(1e3 * mesh.vertices, mesh.faces))
    stl = prepared(tmp_path / "mm.stl", "mm", tmp_path)
    # once joined and rounded the metres and the STEP file are the very same mesh; inches are not, in the last bit
    for file in ("metre.glb", "part.step"):
        assert prepared(tmp_path / file, None, tmp_path).mesh.sha256 == stl.mesh.sha256
    inch = prepared(tmp_path / "inch.obj", "inch", tmp_path)
    for T in stl.space.sample(3, rng, (0.5e-3, 1e-3))[0]:
        assert apart(stl, inch, stl.simulate(T).mask) < 0.01


@pytest.mark.slow
def test_a_curved_step_file_is_localized_within_its_tessellation(few_touches, tmp_path):
    (tmp_path / "round.step").write_text(cylinder_step(8.0, 30.0))
    fine = trimesh.creation.cylinder(8.0, 30.0, sections=1024)
    fine.export(tmp_path / "fine.stl")
    step, stl = (prepared(tmp_path / f, u, tmp_path) for f, u in (("round.step", None), ("fine.stl", "mm")))
    corners = 1e3 * step.mesh.vertices
    assert np.hypot(*corners.T[:2]) == pytest.approx(8.0, abs=1e-4)
    assert abs(corners[:, 2]) == pytest.approx(15.0, abs=1e-4)
    assert max(distances(as_surface(step.mesh), as_surface(stl.mesh))) < 1e-3 * TESSELLATION
    edge = se3.transform(se3.exp([np.pi / 2, 0, 0, 0, 0, 0])[:3, :3], [0, -12e-3, 7.5e-3])
    assert apart(stl, step, stl.simulate(edge).mask) < 0.01 + TESSELLATION


@pytest.mark.parametrize(
    ("name", "content", "unit", "words"),
    [
        ("a.stl", b"", "mm", "the file is empty"),
        ("a.txt", b"x", "mm", "not a supported mesh format"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "mm", "only points or lines|found nothing"),
        ("a.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "mm", "NaN"),
        ("a.obj", b"v 0 0 3e38\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "mm", "beyond 1e9"),
        ("a.ply", b"ply\nformat", "mm", "expected a header from ply to end_header"),
        ("a.stl", b"x", "MMM", "unknown unit 'MMM'; give --unit, one of mm, cm, m, inch"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", None, "does not state its unit; give --unit"),
        ("a.obj", b"v 0 0 0\nv 10 0 0\nv 0 10 0\nf 1 2 3\n", "auto", "likely: 14.1 mm across in mm.*Give --unit"),
    ],
)
def test_an_unreadable_mesh_is_named(name, content, unit, words, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(Refused, match=words):
        read(tmp_path / name, unit, Sensor.load("gelslim"))


L_SHAPE = np.array([(0, 0), (30, 0), (30, 8), (8, 8), (8, 20), (0, 20)], float)


def prism_obj(first):
    """OBJ text of an L-shaped prism whose caps, of six corners each, begin at one of them."""
    corners = [f"v {x:g} {y:g} {z}" for z in (0, 6) for x, y in L_SHAPE]
    order = np.roll(np.arange(6), -first)
    faces = [order[::-1], order + 6] + [[k, (k + 1) % 6, (k + 1) % 6 + 6, k + 6] for k in range(6)]
    return "\n".join([*corners, *("f " + " ".join(str(k + 1) for k in face) for face in faces)])


@pytest.mark.parametrize("first", range(6))
def test_the_proof_rests_on_the_polygons_of_the_file(first, tmp_path, monkeypatch):
    (tmp_path / "l.obj").write_text(prism_obj(first))
    before, _ = read(tmp_path / "l.obj", "mm", Sensor.load("gelslim"))
    proof = prove(before, repair(before, options(before)))
    assert before.area == pytest.approx(1272) and proof.largest < 1e-9 and proof.new == 0

    def fans(self):
        rings = [self.corners[start : start + n] for start, n in zip(self.starts, self.sizes, strict=True)]
        faces = [(ring[0], ring[k], ring[k + 1]) for ring in rings for k in range(1, len(ring) - 1)]
        return np.array(faces), np.repeat(np.arange(len(rings)), self.sizes - 2)

    # read as another program reads it, it is found out wherever a fan leaves the polygon
    monkeypatch.setattr(Polygons, "triangles", fans)
    wrong, _ = read(tmp_path / "l.obj", "mm", Sensor.load("gelslim"))
    assert (prove(wrong, Work(wrong)).largest > 1) == (wrong.area > 1300)


def test_points_on_polygons_are_spread_evenly_and_measured_exactly(rng, tmp_path):
    (tmp_path / "l.obj").write_text(prism_obj(2))
    surface, _ = read(tmp_path / "l.obj", "mm", Sensor.load("gelslim"))
    turn = se3.exp([0.4, -1.1, 0.3, 0, 0, 0])[:3, :3]
    turned = replace(surface.polygons, vertices=surface.polygons.vertices @ turn.T)
    points = (points_on(turned, 100_000) @ turn)[len(turned.corners) :]
    caps = points[np.minimum(abs(points[:, 2]), abs(points[:, 2] - 6)) < 1e-9]
    assert len(points) == pytest.approx(100_000, rel=0.01)
    assert len(caps) / len(points) == pytest.approx(672 / 1272, rel=0.02)
    assert ((caps[:, 0] <= 8) | (caps[:, 1] <= 8)).all()
    assert (caps[:, 1] > 8).mean() == pytest.approx(96 / 336, rel=0.03)
    some = rng.uniform(-5, 35, (500, 3))
    assert distance(surface, some) == pytest.approx(
        distances_from(Surface(surface.vertices, surface.faces), some), abs=1e-5
    )


def obj_of(ring, height, turn=None):
    """OBJ text of a prism of a convex polygon, its walls as quads."""
    n = len(ring)
    corners = np.concatenate([np.column_stack([ring, np.full(n, z)]) for z in (0.0, height)])
    corners = corners if turn is None else corners @ turn.T
    faces = [range(n)[::-1], range(n, 2 * n), *((k, (k + 1) % n, n + (k + 1) % n, n + k) for k in range(n))]
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
    return "\n".join([*lines, *("f " + " ".join(str(k + 1) for k in face) for face in faces)])


PLATE = np.array([(0, 0), (100, 0), (100, 60), (0, 60)], float)


@pytest.mark.parametrize("seed", range(12))
def test_distances_from_thin_plates_and_wedges_are_the_least_over_all_faces(seed, tmp_path):
    rng = np.random.default_rng(seed)
    thin = float(np.exp(rng.uniform(np.log(0.01), np.log(1))))
    ring = PLATE if seed % 2 else np.array([(0, 0), (100, 0), (0, thin)], float)
    turn = np.eye(3) if seed % 4 < 2 else se3.random_rotations(1, rng)[0]
    (tmp_path / "a.obj").write_text(obj_of(ring, thin if seed % 2 else 60.0, turn))
    surface, _ = read(tmp_path / "a.obj", "mm", Sensor.load("gelslim"))
    on = points_on(surface.polygons, 2000)
    near = on + rng.normal(size=on.shape) * rng.choice([1e-5, 0.01, 0.3, 10], len(on))[:, None]
    points = np.concatenate([on, near])
    n = len(surface.faces)
    nearest = trimesh.triangles.closest_point(
        np.tile(surface.corners, (len(points), 1, 1)), np.repeat(points, n, axis=0)
    )
    expected = np.linalg.norm(nearest - np.repeat(points, n, axis=0), axis=1).reshape(-1, n).min(1)
    np.testing.assert_allclose(distance(surface, points), expected, rtol=1e-9, atol=1.1e-7 * surface.size)


@pytest.mark.parametrize(
    ("ring", "height"),
    [
        (PLATE, 0.5),
        pytest.param(PLATE, 0.2, marks=pytest.mark.slow),
        pytest.param([(0, 0), (100, 0), (0, 0.3)], 60.0, marks=pytest.mark.slow),
        ([(0, 0), (100, 0), (0, 0.2)], 20.0),
        pytest.param([(0, 0), (10, 0), (10, 10), (10, 20), (10, 10), (0, 10)], 6.0, marks=pytest.mark.slow),
    ],
)
def test_thin_plates_wedges_and_spikes_are_clean(ring, height, here, tmp_path):
    (tmp_path / "thin.obj").write_text(obj_of(np.array(ring, float), height))
    done = here(tmp_path / "thin.obj", "--unit", "mm", "--out", tmp_path / "out", "--json")
    (result,) = json.loads(done.stdout)["meshes"]
    assert result["outcome"] != "refused" and result["deviation_mm"] < 1e-4, result


def test_a_spike_without_area_is_no_deviation(tmp_path):
    text = obj_of(np.array([(0, 0), (10, 0), (10, 10), (0, 10)], float), 6.0).replace("f 5 6 7 8", "f 5 6 7 9 10 9 7 8")
    lines = text.splitlines()
    (tmp_path / "a.obj").write_text("\n".join([*lines[:8], "v 10.0 15.0 6.0", "v 10.0 20.0 6.0", *lines[8:]]))
    surface, _ = read(tmp_path / "a.obj", "mm", Sensor.load("gelslim"))
    assert points_on(surface.polygons, 1000)[:, 1].max() == 10
    assert prove(surface, repair(surface, options(surface))).largest < 1e-4


def test_a_file_of_folded_triangles_is_refused_and_a_warning_is_printed(here, tmp_path):
    ring = [(x, y, z) for z in (0.0, 6.0) for x, y in L_SHAPE]
    faces = [(0, k + 1, k) for k in range(1, 5)] + [(6, 6 + k, 7 + k) for k in range(1, 5)]
    faces = [tuple((c + 1) % 6 + 6 * (c // 6) for c in face) for face in faces]
    faces += [f for k in range(6) for f in ((k, (k + 1) % 6, (k + 1) % 6 + 6), (k, (k + 1) % 6 + 6, k + 6))]
    trimesh.Trimesh(ring, faces, process=False).export(tmp_path / "fan.stl")
    BOX.export(tmp_path / "box.stl")
    with open(tmp_path / "box.stl", "ab") as file:
        file.write(b"end")
    done = here(tmp_path / "fan.stl", tmp_path / "box.stl", "--unit", "mm", "--out", tmp_path / "out", "--json")
    fan, box = json.loads(done.stdout)["meshes"]
    assert fan["outcome"] == "refused" and "folded back onto their neighbours" in fan["reason"], fan
    assert box["warnings"] == ["3 bytes after the last triangle are passed over"]


def test_a_unit_that_contradicts_the_file_is_refused(tmp_path):
    BOX.export(tmp_path / "box.glb")
    with pytest.raises(Refused, match="the file says m, but --unit mm was given"):
        read(tmp_path / "box.glb", "mm", Sensor.load("gelslim"))
    with pytest.raises(Refused, match="no such file"):
        read(tmp_path / "none.stl", "mm", Sensor.load("gelslim"))


def test_units_are_given_in_upper_or_lower_case(tmp_path):
    BOX.export(tmp_path / "box.stl")
    for unit in ("mm", "MM", "Inch"):
        assert read(tmp_path / "box.stl", unit, Sensor.load("gelslim"))[1] == unit.lower()


@pytest.fixture(scope="module")
def inch_box():
    """A box of 1 x 0.8 x 0.5 inches as 3MF."""
    mesh = trimesh.creation.box((1.0, 0.8, 0.5))
    data = mesh.export(file_type="3mf")
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            new.writestr(name, old.read(name).replace(b'unit="millimeter"', b'unit="inch"'))
    return out.getvalue()


def test_the_unit_of_a_file_is_kept_in_its_copies(here, inch_box, tmp_path):
    (tmp_path / "part.3mf").write_bytes(inch_box)
    done = here(tmp_path / "part.3mf", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert "part.3mf: clean, in inch" in done.output
    made = tmp_path / "out" / "part.ply"
    assert f"next: geomtact localize IMAGE --object {made} --unit inch --sensor gelslim" in done.output
    assert b"\ncomment unit: inch\n" in made.read_bytes()
    for unit in (None, "inch"):
        np.testing.assert_allclose(np.ptp(load_mesh(made, unit).vertices, axis=0), np.multiply(25.4e-3, [1, 0.8, 0.5]))
    with pytest.raises(MeshError, match="a comment in it states the unit inch, but the unit mm was given"):
        load_mesh(made, "mm")
    again = here(made, "--out", tmp_path / "again", "--json")
    assert json.loads(again.stdout)["meshes"][0]["unit"] == "inch"
    assert (tmp_path / "again" / "part.ply").read_bytes() == made.read_bytes()
    assert "the file says inch, but --unit mm was given" in here(made, "--unit", "mm", "--out", tmp_path / "c").output


def test_of_several_files_the_unit_is_for_those_that_need_one(here, inch_box, tmp_path):
    (tmp_path / "a.3mf").write_bytes(inch_box)
    BOX.export(tmp_path / "b.stl")
    BOX.copy().apply_scale(1e-3).export(tmp_path / "c.glb")
    done = here(*(tmp_path / name for name in ("a.3mf", "b.stl", "c.glb")), "--unit", "cm", "--json", "--out", tmp_path)
    assert [result["unit"] for result in json.loads(done.stdout)["meshes"]] == ["inch", "cm", "m"]


def test_nothing_is_written_over_the_input(command, tmp_path):
    BOX.export(tmp_path / "box.ply")
    before = (tmp_path / "box.ply").read_bytes()
    done = command(tmp_path / "box.ply", "--unit", "mm", "--out", tmp_path)
    assert done.exit_code == 2 and "written" in done.output and (tmp_path / "box.ply").read_bytes() == before
    done = command(tmp_path / "box.ply", "--unit", "mm", "--out", tmp_path / "box.ply")
    assert done.exit_code == 2 and "cannotbemadeafolder" in "".join(filter(str.isalpha, done.output))
    files = [Path("a/part.stl"), Path("b/part.stl"), Path("part_2.stl"), Path("c/part.stl")]
    assert prep_mesh._names(files) == ["part", "part_3", "part_2", "part_4"]


@pytest.mark.slow
def test_a_folder_gets_a_table_and_refused_meshes_leave_nothing(command, tmp_path):
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    BOX.export(folder / "box.stl")
    open_box = BOX.submesh([np.arange(10)], append=True)
    open_box.export(folder / "open.stl")
    (folder / "._box.stl").write_bytes(b"\0\5\x16\7")
    (folder / ".trash").mkdir()
    BOX.export(folder / ".trash" / "old.stl")
    done = command(folder, "--unit", "mm", "--out", out, "--json")
    assert done.exit_code == 0, done.output
    results = {r["name"]: r for r in json.loads(done.stdout)["meshes"]}
    assert (results["box"]["outcome"], results["open"]["outcome"]) == ("clean", "refused")
    assert "is wider than 5" in results["open"]["reason"] or "wider than" in results["open"]["reason"]
    assert results["box"]["volume_mm3"]["after"] == pytest.approx(480)
    assert (results["box"]["symmetry"]["kind"], results["box"]["symmetry"]["order"]) == ("discrete", 4)
    assert sorted(p.name for p in out.iterdir()) == ["box.json", "box.ply", "box.png"]


def test_a_mesh_that_takes_too_long_is_given_up(command, tmp_path, monkeypatch):
    BOX.export(tmp_path / "box.stl")
    monkeypatch.setattr(prep_mesh, "SECONDS", 0.05)
    done = command(tmp_path / "box.stl", "--unit", "mm", "--out", tmp_path / "out")
    assert done.exit_code == 3 and "takes more than" in done.output
    assert list((tmp_path / "out").iterdir()) == []


def test_an_object_of_a_catalogue_is_given_by_its_name(here, tmp_path, monkeypatch):
    BOX.export(tmp_path / "crate.stl")
    folder = tmp_path / "parts"
    done = here(tmp_path / "crate.stl", "--unit", "mm", "--out", tmp_path / "out", "--add-to", folder)
    assert done.exit_code == 0, done.output
    monkeypatch.setattr(catalogues, "meshes_folder", lambda: folder)
    catalogues.catalogue.cache_clear()
    try:
        assert list(catalogues.catalogue()) == ["crate"]
        entry = (folder / "catalogue.toml").read_text("utf-8")
        # added again it takes its own place; beside others it takes none of theirs
        symmetry = load_mesh("crate").symmetry
        for _ in range(2):
            add([tmp_path / "out" / "crate.ply"], "mm", "unknown", "made of crate", [symmetry], folder)
        assert (folder / "catalogue.toml").read_text("utf-8") == entry
        (folder / "catalogue.toml").write_text(entry + "\n" + entry.replace("crate", "other"), "utf-8")
        add([tmp_path / "out" / "crate.ply"], "mm", "MIT", "a crate", [symmetry], folder)
        both = tomllib.loads((folder / "catalogue.toml").read_text("utf-8"))
        assert (both["crate"]["licence"], both["other"]["licence"]) == ("MIT", "unknown")
        mesh = load_mesh("crate")
        assert mesh.unit == "mm" and len(mesh.symmetry.elements) == 4
        np.testing.assert_allclose(mesh.vertices.max(0), [5e-3, 4e-3, 3e-3], atol=1e-9)
    finally:
        monkeypatch.undo()
        catalogues.catalogue.cache_clear()


@pytest.mark.slow
def test_real_nuts_and_gear_become_solids_where_they_were(data_folder, tmp_path):
    for file in ("factory_nut_m16_tight_subdiv_3x", "factory_gear_small_space_5e-4"):
        before, _ = read(data_folder / "meshes_factory_nist" / f"{file}.obj", "m", Sensor.load("gelslim"))
        work = repair(before, options(before, max_hole=5e-3, max_error=2.5e-5))
        assert prove(before, work).largest < 5e-5 and not work.holes
        write_ply(tmp_path / "part.ply", work.surface, "m")
        assert trimesh.load_mesh(tmp_path / "part.ply").is_volume
        mesh = load_mesh(tmp_path / "part.ply", "m")
        if "nut" in file:  # the thread is a helix: six-fold only to within its pitch
            # 60 degrees move it by 0.30 mm, 180 by 0.87; it can be turned over to within a micrometre
            symmetry = mesh.with_symmetry(5e-5).symmetry
            assert symmetry.kind == "discrete" and len(symmetry.elements) == 2
