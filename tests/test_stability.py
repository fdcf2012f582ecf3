"""Robustness: each sweep changes the stated quantity and nothing else, and its figures follow from the records."""

import json
from dataclasses import replace

import cv2
import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from geomtact import Sensor, load_mesh
from geomtact.contact_space.contact_class import CLASSES, contact_class
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touches import penetrations
from geomtact.errors import NoPoseAgreesError
from geomtact.evaluation import simultaneous_touches
from geomtact.inference.effort import GRID_ALONE
from geomtact.json_values import plain
from geomtact.se3 import inverse
from geomtact.sensing.noise import CLEAN, MODERATE
from tools.studies.__main__ import app as studies
from tools.studies.common import study_options
from tools.studies.common.answer import REFUSED, Answer, judged
from tools.studies.stability import command as evaluate_stability
from tools.studies.stability import study as stability
from tools.studies.stability import worlds
from tools.studies.stability.plot import draw_stability
from tools.studies.stability.study import SWEEPS, opposed
from tools.studies.stability.worlds import World, cut_off, knobbed, larger, scanned
from tools.studies.track.trajectories import random_trajectory

pytestmark = pytest.mark.studies

MM = 1e-3


@pytest.fixture(scope="module")
def here(plug):
    return World(plug.mesh, plug.sensor, MODERATE, penetrations(plug.space))


# --- worlds


def test_the_first_level_of_each_perturbation_is_the_localizers_own_world(here):
    for name in ("pitch", "size", "surface", "faces", "detail", "kind"):
        world = SWEEPS[name].world(here, SWEEPS[name].levels[0])
        assert np.array_equal(world.mesh.faces, here.mesh.faces)
        assert world.mesh.vertices == pytest.approx(here.mesh.vertices, abs=1e-12)
        assert replace(world, mesh=here.mesh) == here
    for sweep in SWEEPS.values():
        assert set(sweep.inside) <= set(sweep.levels)
        assert (sweep.world is None) != (sweep.ask is None)


def test_outside_the_contact_pose_space_the_error_is_that_of_the_pose_itself(plug, a_touch):
    T, mask = a_touch(plug)
    posterior = plug.localize(mask, "mask", effort=GRID_ALONE)
    deeper = T.copy()
    deeper[2, 3] -= 3 * MM
    answer, at_home = judged(plug.mesh, deeper, posterior, T), judged(plug.mesh, T, posterior)
    assert (answer.gain, answer.level) == (at_home.gain, at_home.level)
    assert answer.mssd_mm == judged(plug.mesh, deeper, posterior).mssd_mm != at_home.mssd_mm


def test_every_mode_of_an_unknown_object_is_wrong(plug):
    sweep = SWEEPS["other_part"]
    answers = list(stability.swept(plug, sweep, 1, 4, 3, "fast"))
    assert len(answers) == 4 and all(a.wrong and a.gain == -np.inf and a.level == 1 for a in answers)
    assert all(a.gain > -np.inf for a in stability.swept(plug, sweep, 0, 4, 3, "fast"))


def test_a_sequence_is_evaluated_at_its_last_frame(flat_nut, monkeypatch):
    monkeypatch.setattr(stability, "_FRAMES", 8)
    answers = list(stability.swept(flat_nut, SWEEPS["slips"], 1, 2, 3, "fast"))
    for number, answer in enumerate(answers):
        made = random_trajectory(flat_nut.space, 8, 3000 + number, 2 * MM, slips=(4,), elastic=number % 2 == 1)
        frames = list(flat_nut.track(made.masks, effort="fast", kind="mask", seed=3))
        slipped = any("possible slip" in warning for frame in frames for warning in frame.warnings)
        assert answer == replace(judged(flat_nut.mesh, made.T_sensor_object[-1], frames[-1]), warned=slipped)
    assert any(answer.warned for answer in answers)


@pytest.mark.parametrize("degrees", [0, 10, 90])
def test_a_jaw_closes_along_lines_that_are_so_far_apart(plug, a_touch, degrees):
    """The second sensor looks against the first, but for the angle, along a line through its origin, and presses the
    object as deep as asked."""
    T, _ = a_touch(plug)
    second = opposed(T, np.radians(degrees), 0.7, plug.space, 1 * MM)
    assert second is not None
    assert second[:3, 2] @ [0, 0, -1] == pytest.approx(np.cos(np.radians(degrees)), abs=1e-9)
    origin, along = second[:3, 3], second[:3, 2]
    assert np.linalg.norm(np.cross(origin, along)) < 1e-9
    assert plug.space.penetration((inverse(second) @ T)[None])[0] == pytest.approx(1 * MM, abs=0.05 * MM)


def test_a_larger_object_grows_about_its_centre():
    mesh = load_mesh("connector_plug")
    grown = larger(mesh, 5)
    assert grown.centre == pytest.approx(mesh.centre, abs=1e-9)
    assert grown.vertices - mesh.centre == pytest.approx(1.05 * (mesh.vertices - mesh.centre), abs=1e-9)


def test_a_scanned_object_deviates_by_the_stated_amount():
    """How far points of the scan lie from a ball's surface is the displacement itself."""
    ball = load_mesh("ball")
    radius = np.linalg.norm(ball.vertices - ball.centre, axis=1).mean()
    off = np.linalg.norm(scanned(ball, 0.2 * MM).vertices - ball.centre, axis=1) - radius
    assert np.sqrt((off**2).mean()) == pytest.approx(0.2 * MM, rel=0.15)
    assert abs(off.mean()) < 0.1 * MM
    assert np.array_equal(scanned(ball, 0.2 * MM).vertices, scanned(ball, 0.2 * MM).vertices)


def test_a_coarser_object_keeps_the_stated_number_of_faces():
    mesh = load_mesh("connector_plug")
    here = World(mesh, Sensor.load("gelslim"), MODERATE, (3e-4, 1e-3))
    assert len(SWEEPS["faces"].world(here, 30).mesh.faces) == pytest.approx(0.3 * len(mesh.faces), rel=0.05)


def test_pixels_larger_than_stated_show_a_smaller_contact(here, plug):
    world = replace(SWEEPS["pitch"].world(here, 10), noise=CLEAN, threshold=0.0)
    whole = 0
    for T, mask in worlds.touches(world, 16, 3):
        if cut_off(mask) == 0:
            whole += 1
            assert plug.simulate(T).mask.sum() == pytest.approx(1.21 * mask.sum(), rel=0.03)
    assert whole >= 2


@pytest.mark.parametrize("level", [0, 0.2])
def test_a_halo_is_where_the_object_is_within_a_gap_above_the_gel(level):
    """Around a ball it is a disc as large as that of one pressed in deeper by as much."""
    ball = load_mesh("ball")
    radius = np.linalg.norm(ball.vertices - ball.centre, axis=1).mean()
    here = World(ball, Sensor.load("gelsight-mini"), CLEAN, (3e-4, 1e-3), border=(0.0, 0.0))
    space, found = ContactSpace(ball, here.sensor), 0
    for T, mask in worlds.touches(SWEEPS["halo"].world(here, level), 4, 3):
        deep = float(space.penetration(T[None])[0]) + level * MM
        area = mask.sum() * np.prod(here.sensor.pixel_pitch)
        assert area == pytest.approx(np.pi * (2 * radius * deep - deep**2), rel=0.03)
        found += 1
    assert found == 4


@pytest.mark.parametrize(("name", "level"), [("area", 4), ("area", 1), ("border", 10), ("border", 0)])
def test_touches_are_as_the_sweep_wants_them(here, name, level):
    world = replace(SWEEPS[name].world(here, level), noise=CLEAN)
    pixel = np.prod(world.sensor.pixel_pitch)
    found = list(worlds.touches(world, 4, 1))
    assert len(found) == 4
    for _, mask in found:
        assert world.area[0] <= mask.sum() * pixel <= world.area[1]
        assert world.border[0] <= cut_off(mask) <= world.border[1]


@pytest.mark.parametrize("level", [1, 2, 3])
def test_contacts_are_of_the_kind_that_the_sweep_wants(here, level):
    world = replace(SWEEPS["kind"].world(here, level), threshold=0.0)
    space = ContactSpace(world.mesh, world.sensor)
    found = list(worlds.touches(world, 3, 1))
    assert [contact_class(space, T) for T, _ in found] == [CLASSES[level - 1]] * 3


@pytest.mark.parametrize("level", [1, 2, 3])
def test_masks_show_as_many_patches_as_the_sweep_wants(here, level):
    found = list(worlds.touches(SWEEPS["shown"].world(here, level), 3, 1))
    for _, mask in found:
        _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
        large = np.bincount(labels.ravel())[1:] * np.prod(here.sensor.pixel_pitch) >= 0.3 * MM**2
        assert min(large.sum(), 3) == level
    assert len(found) == 3


def test_knobs_stand_out_of_the_surface_and_leave_the_rest_as_it_was(here):
    mesh = knobbed(here.mesh, 1 * MM)
    assert np.array_equal(mesh.vertices[: len(here.mesh.vertices)], here.mesh.vertices)
    assert np.array_equal(mesh.faces[: len(here.mesh.faces)], here.mesh.faces)
    knobs = mesh.vertices[len(here.mesh.vertices) :].reshape(12, -1, 3)
    centres = knobs.mean(1)
    assert np.linalg.norm(knobs - centres[:, None], axis=2) == pytest.approx(1 * MM, rel=1e-6)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(here.mesh.vertices.astype(np.float32), here.mesh.faces.astype(np.uint32))
    assert scene.compute_distance(centres.astype(np.float32)).numpy() == pytest.approx(0, abs=1e-7)


def test_a_condition_that_no_touch_fulfils_ends(here, monkeypatch):
    monkeypatch.setattr(worlds, "TRIED", 40)
    assert list(worlds.touches(replace(here, area=(1.0, 2.0), threshold=0.0), 1, 0)) == []


def test_the_outline_cut_off_is_counted_in_pixel_edges():
    mask = np.zeros((6, 8), bool)
    assert cut_off(mask) == 0
    mask[2:4, 2:4] = True
    assert cut_off(mask) == 0
    assert cut_off(np.ones((6, 8), bool)) == 1
    mask[:] = False
    mask[:2, 3:6] = True  # three edges of ten at the top
    assert cut_off(mask) == pytest.approx(0.3)


# --- records


def test_an_unperturbed_world_gives_the_localizers_own_posteriors(plug, here):
    answers = list(stability.swept(plug, SWEEPS["size"], 0, 2, 5, "fast"))
    for answer, (T, mask) in zip(answers, worlds.touches(here, 2, 5), strict=True):
        assert answer == judged(plug.mesh, T, plug.localize(mask, "mask", effort="fast", seed=5))
        assert np.isfinite(answer.gain)


def test_a_pose_of_another_world_is_moved_along_the_sensors_axis_into_the_space(plug, here):
    (T, _), *_ = worlds.touches(replace(here, threshold=0.0), 1, 2)
    assert stability._knowable(plug.space, T) is T
    off = T.copy()
    off[2, 3] -= plug.sensor.max_penetration
    back = stability._knowable(plug.space, off)
    assert np.isfinite(plug.space.penetration(back[None])[0])
    assert (inverse(off) @ back)[:3, :3] == pytest.approx(np.eye(3)) and back[:2, 3] == pytest.approx(off[:2, 3])


@pytest.fixture
def poses_given(plug, monkeypatch):
    """The sensor poses of every scene that is localized, none of which is answered."""
    poses = []

    def localize(self, masks, kind, T_world_sensor, **options):
        poses.append(T_world_sensor)
        raise NoPoseAgreesError("none")

    monkeypatch.setattr(plug.__class__, "localize", localize)
    return poses


@pytest.mark.parametrize(
    ("name", "level", "mm", "degrees"), [("rig_shift", 0, 0, 0), ("rig_shift", 5, 5, 0), ("rig_turn", 5, 0, 5)]
)
def test_extrinsics_are_perturbed_as_stated_except_for_the_first_sensor(plug, poses_given, name, level, mm, degrees):
    answers = list(stability.swept(plug, SWEEPS[name], level, 8, 1, "fast"))
    assert answers == [REFUSED] * 8
    true = [scene.T_world_sensor for scene in simultaneous_touches(plug.space, 8, 3, 1)]
    off = inverse(np.array(true)) @ np.array(poses_given)
    assert off[:, 0] == pytest.approx(np.tile(np.eye(4), (8, 1, 1)))
    turned = Rotation.from_matrix(off[:, 1:, :3, :3].reshape(-1, 3, 3)).magnitude()
    # 16 of each, with these root mean squares
    assert np.sqrt((off[:, 1:, :3, 3] ** 2).sum(-1).mean()) == pytest.approx(mm * MM, rel=0.3, abs=1e-9)
    assert np.degrees(np.sqrt((turned**2).mean())) == pytest.approx(degrees, rel=0.3, abs=1e-5)


def test_a_jaws_levels_are_degrees(plug, poses_given):
    list(stability.swept(plug, SWEEPS["jaw"], 30, 3, 1, "fast"))
    assert len(poses_given) == 3
    for _, second in poses_given:
        assert second[2, 2] == pytest.approx(-np.cos(np.radians(30)), abs=1e-9)


def test_figures_follow_from_the_records():
    answers = [
        Answer(2.0, 1.0, 0.3, 1.0, 0.9, False),  # right
        Answer(1.0, 1.0, 0.7, 1.0, 0.9, True),  # right, and yet warned
        Answer(-1.0, 1.0, 0.95, 50.0, 0.9, False),  # an undetected failure
        Answer(0.0, 1.0, 0.6, 50.0, 0.2, False),  # wrong, not sure
        Answer(-np.inf, 1.0, 1.0, np.inf, 0.9, True),  # wrong, warned
    ]
    figures = stability.summarise(answers)
    assert [a.silent for a in answers] == [False, False, True, False, False]
    assert figures | {"coverage": None} == {
        "n": 5,
        "gain_mean": 0.5,
        "claimed_mean": 1.0,
        "ruled_out": pytest.approx(0.2),
        "mssd_mm_median": 50.0,
        "wrong": 0.6,
        "certain": 0.8,
        "warned": 0.4,
        "silent": 0.2,
        "found_out": pytest.approx(2 / 3),
        "alarmed": 0.5,
        "coverage": None,
    }
    assert [c["share"] for c in figures["coverage"]] == [0.2, 0.6]


# --- the command


@pytest.fixture(scope="module")
def command(plug):
    def run(*words, status=0):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(study_options, "localizers", lambda *_: iter([plug]))
            done = CliRunner().invoke(studies, [str(w) for w in ("stability", "connector_plug", *words)])
            assert done.exit_code == status, done.output
            return done

    return run


def test_a_stopped_study_goes_on_and_its_picture_comes_from_the_file_alone(command, tmp_path, monkeypatch):
    for name, levels in {"specks": (2, 60), "size": (0, 5)}.items():
        monkeypatch.setitem(SWEEPS, name, replace(SWEEPS[name], levels=levels, inside=levels[:1]))
    words = ["--touches", 1, "--effort", "fast", "--sweep", "specks", "--sweep", "size"]
    done = command(*words, "--out", tmp_path / "whole.json", "--plot", tmp_path / "whole.png")
    assert "specks of dirt" in done.output and "60*" in done.output
    whole = json.loads((tmp_path / "whole.json").read_text("utf-8"))
    assert (tmp_path / "whole.png").read_bytes() == draw_stability(whole)
    sweep = whole["parts"]["connector_plug"]["sweeps"]["size"]
    answers = evaluate_stability._answers(sweep["levels"][0]["answers"])
    assert sweep["levels"][0]["figures"]["gain_mean"] == pytest.approx(
        stability.summarise(answers)["gain_mean"], abs=1e-3
    )

    swept, calls = stability.swept, []

    def stops(localizer, sweep, level, *args):
        calls.append(level)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return swept(localizer, sweep, level, *args)

    monkeypatch.setattr(stability, "swept", stops)
    command(*words, "--out", tmp_path / "part.json", status=130)
    monkeypatch.setattr(stability, "swept", swept)
    assert len(json.loads((tmp_path / "part.json").read_text("utf-8"))["parts"]["connector_plug"]["sweeps"]) == 1
    command(*words, "--out", tmp_path / "part.json")
    assert json.loads((tmp_path / "part.json").read_text("utf-8")) == whole
    assert whole["schema"] == evaluate_stability.SCHEMA


def test_the_records_of_all_objects_are_pooled():
    one, other = Answer(1.23456, 1.0, 0.3, 1.0, 0.9, False), REFUSED

    def part(*answers, effort="fast"):
        settings = dict.fromkeys(evaluate_stability._ALIKE) | {"effort": effort}
        level = {"level": 2, "figures": stability.summarise(answers), "answers": evaluate_stability._columns(answers)}
        sweeps = {"specks": {"title": "specks", "inside": [2], "levels": [plain(level)]}}
        return {"settings": settings, "sweeps": sweeps}

    judged_otherwise = part(one, effort="exact")
    (level,) = evaluate_stability._together([part(one, one), part(other), judged_otherwise])["specks"]["levels"]
    rounded = replace(one, gain=1.2346)
    assert level == {"level": 2, "figures": stability.summarise([rounded, rounded, other])}


def test_a_level_that_no_touch_fulfils_is_left_out_and_the_others_are_evaluated_once(command, tmp_path, monkeypatch):
    asked = []

    def swept(localizer, sweep, level, *args):
        asked.append(level)
        return iter([] if level == 6 else [Answer(1.0, 1.0, 0.3, 1.0, 0.9, False)])

    monkeypatch.setattr(stability, "swept", swept)
    words = ["--touches", 1, "--sweep", "specks", "--out", tmp_path / "a.json"]
    command(*words)
    command(*words, "--plot", tmp_path / "a.png")
    assert asked == [0, 2, 6, 20, 60, 6]
    part = json.loads((tmp_path / "a.json").read_text("utf-8"))["parts"]["connector_plug"]
    assert [at["level"] for at in part["sweeps"]["specks"]["levels"]] == [0, 2, 20, 60]


def test_unperturbed_touches_are_shared_by_all_sweeps(plug, monkeypatch):
    known, sweep = [], SWEEPS["noise"]
    at_home = [level for level in sweep.levels if level == 1e3 * MODERATE.outline_rms]
    first = list(stability.swept(plug, sweep, at_home[0], 2, 1, "fast", known))
    monkeypatch.setattr(stability, "_alone", None)
    assert list(stability.swept(plug, SWEEPS["size"], 0, 2, 1, "fast", known)) == first == known


def test_an_unknown_sweep_is_refused(command):
    assert evaluate_stability._NAMES.split(", ") == list(SWEEPS)
    assert "no sweep named 'nois'" in command("--sweep", "nois", status=2).output


def test_an_unknown_object_without_figures_is_printed(command, tmp_path, monkeypatch):
    monkeypatch.setitem(SWEEPS, "other_part", replace(SWEEPS["other_part"], levels=(1,), inside=()))
    words = ["--touches", 4, "--effort", "fast", "--sweep", "other_part"]
    done = command(*words, "--out", tmp_path / "outcomes.json")
    sweeps = json.loads((tmp_path / "outcomes.json").read_text("utf-8"))["parts"]["connector_plug"]["sweeps"]
    (at,) = sweeps["other_part"]["levels"]
    assert at["figures"]["gain_mean"] is None and at["figures"]["wrong"] == 1
    assert "another part" in done.output
