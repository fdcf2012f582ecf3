"""Evaluation of registration: observability agrees with the simulator, and every method has the same starting poses."""

import io
import json

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from geomtact import load_mesh, se3
from geomtact.contact_space.build import choose_resolution
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import simulate_mask
from geomtact.contact_space.touches import random_touches
from geomtact.geometry.rotations import Directions
from geomtact.registration.contact_problem import make_problem
from geomtact.registration.observability import Spread, motion_of, moved
from geomtact.registration.protocol import Problem
from geomtact.registration.surface import Surface
from geomtact.sensing.noise import CLEAN, MODERATE, Noise
from geomtact.sensing.sensor import Sensor
from tools.studies.__main__ import app as studies
from tools.studies.registration import study as registration
from tools.studies.registration.information import agreement, fisher_information, split
from tools.studies.registration.peers import peers
from tools.studies.registration.shapes import SHAPES, shape
from tools.studies.registration.study import End, Grid, Seen, Trial, own_methods, summarise, trials

pytestmark = pytest.mark.studies

SENSOR = Sensor("small", (120, 90), (0.15e-3, 0.15e-3), 0.0, 2e-3)


@pytest.fixture(scope="module")
def ball():
    return ContactSpace(load_mesh("ball").with_symmetry(), SENSOR)


@pytest.fixture(scope="module")
def nut():
    return ContactSpace(load_mesh("hex_nut").with_symmetry(), SENSOR)


def stay(seen, start):
    return End(start, True)


def touches_of(space, n, elastic=None, noise=CLEAN):
    return random_touches(space, n, 3, elastic, noise)


def pressed_in_the_middle(space, depth=0.8e-3):
    """A pose (4, 4) of the object, unturned, with its middle above the window's."""
    T = np.eye(4)
    T[:3, 3] = [0.7e-3, -0.4e-3, 20e-3] - space.mesh.centre
    settled, ok = space.settle(T[None], depth)
    assert ok[0]
    return settled[0]


@pytest.mark.parametrize("elastic", [False, True])
def test_a_ball_constrains_its_position_and_not_its_rotation(ball, elastic):
    T = pressed_in_the_middle(ball)
    problem = make_problem(simulate_mask(ball, T, elastic), SENSOR)
    spread = Spread(0.8e-3 / problem.length / np.sqrt(12), 0.8e-3 / np.sqrt(12))
    observable, rest = split(fisher_information(ball, T, elastic, problem, MODERATE), spread, problem.length)
    assert np.trace(observable) == pytest.approx(3) and np.allclose(observable @ observable, observable)
    assert np.allclose(observable + rest, np.eye(6))
    centre = T @ np.append(ball.mesh.centre, 1)
    for axis in np.eye(3):
        # a turn about the contact's centre that is undone by a shift leaves the ball where it is
        zeta = np.append(axis * problem.length, np.cross(axis, problem.centre - centre[:3]))
        zeta /= np.linalg.norm(zeta)
        assert np.linalg.norm(observable @ zeta) < 0.15


def test_information_is_that_of_the_outline(ball):
    """A disk of radius a shifted along x moves its outline by the cosine of the normal, which is a half in mean square: pi a
    over the noise's correlation, sqrt(pi) times its length, is the information, per noise variance; to a fifth."""
    T = pressed_in_the_middle(ball)
    mask = simulate_mask(ball, T, False)
    problem = make_problem(mask, SENSOR)
    radius = np.sqrt(mask.sum() * SENSOR.pixel_area(mask.shape) / np.pi)
    noise = Noise(outline_rms=0.2e-3, correlation=(1e-3, 3e-3))
    found = fisher_information(ball, T, False, problem, noise, pixel_noise=0.0)
    expected = np.sqrt(np.pi) * radius / 2e-3 / 0.2e-3**2
    assert np.diag(found)[3:5] == pytest.approx(expected, rel=0.2)


def test_a_touch_that_no_motion_changes_constrains_nothing():
    observable, rest = split(np.zeros((6, 6)), Spread(0.1, 1e-3), 5e-3)
    assert (observable == 0).all() and np.allclose(rest, np.eye(6))


def test_observability_depends_on_the_grid_and_not_on_the_unit_of_rotation():
    """A quarter of the grid's step, in shifts and in turns, separates observable from unobservable directions."""
    spread, length = Spread(np.radians(6) / np.sqrt(12), 4e-3 / np.sqrt(12)), 2e-3
    step = np.repeat([np.radians(6) * length, 4e-3], 3)
    for factor, expected in ((0.99, 6), (1.01, 0)):
        observable, _ = split(np.diag((factor * step / 4) ** -2.0), spread, length)
        assert np.trace(observable) == pytest.approx(expected)


def test_agreement_counts_directions():
    spread, length = Spread(0.1, 1e-3), 10e-3
    sharp = np.diag(100 / spread.metres(length) ** 2)
    rows = np.random.default_rng(0).normal(size=(6, 6))  # all is observable, however it is measured
    assert agreement(sharp, rows, spread, length) == 1 and agreement(0 * sharp, rows, spread, length) == 0
    assert agreement(sharp, rows[:0], spread, length) == 0 and agreement(0 * sharp, rows[:0], spread, length) == 1
    half = sharp.copy()
    half[:3, :3] = 0
    assert agreement(half, np.eye(6)[3:], spread, length) == 1 and agreement(half, np.eye(6)[:3], spread, length) == 0


def grid_of(space):
    resolution = choose_resolution(space.mesh, space.sensor, None, 200_000)
    directions = resolution.directions(space.mesh.symmetry, None)
    return Grid(directions, resolution)


@pytest.mark.parametrize("name, turned", [("sphere", [0.0, 0.3, 0.2]), ("rod", [0.0, 0.0, 0.3])])
def test_a_symmetry_direction_is_not_observable(name, turned):
    """The same contact, the object turned within its symmetry: no error, however the object lies to the pixels."""
    space = ContactSpace(shape(name).with_symmetry(), Sensor("s", (320, 240), (0.07e-3, 0.07e-3), 20e-3, 2e-3))
    T = se3.transform(
        se3.exp([0, 0, 0.4, 0, 0, 0])[:3, :3] @ se3.exp([0, np.pi / 2, 0, 0, 0, 0])[:3, :3], [1e-3, 0.5e-3, 0]
    )
    settled, ok = space.settle(T[None], 0.9e-3)
    assert ok[0]
    T = settled[0]
    mask = simulate_mask(space, T, False)
    problem = make_problem(mask, space.sensor)
    grid = Grid(
        Directions.make(space.mesh.symmetry, None, 1, 0.25), choose_resolution(space.mesh, space.sensor, None, 20_000)
    )
    observable, _ = split(
        fisher_information(space, T, False, problem, MODERATE), Spread(np.radians(4), 2e-3), problem.length
    )
    other = T @ se3.exp([*turned, 0, 0, 0])
    assert (simulate_mask(space, other, False) ^ mask).mean() < 1e-3 and grid.spread.rotation > 0
    assert np.linalg.norm(observable @ motion_of(T, other, problem)) < 0.15e-3


def test_every_method_starts_from_the_same_pose_at_the_stated_distance(nut):
    touches = touches_of(nut, 3)
    seen = {"a": [], "b": []}

    def spying(name):
        def method(contact, start):
            seen[name].append(start)
            return End(start, True)

        return method

    methods = {name: spying(name) for name in seen}
    grid = grid_of(nut)
    whole = list(trials(nut, touches, lambda _: methods, grid, CLEAN, 5, turns_deg=(0.0, 5.0), shifts_mm=(0.0, 2.0)))
    assert [len(some) for some in whole] == [14, 14, 14]
    np.testing.assert_array_equal(seen["a"], seen["b"])
    for i, touch in enumerate(touches):
        problem = make_problem(touch.mask, SENSOR)
        for start, trial in zip(seen["a"][7 * i :], whole[i][:-6:2], strict=False):
            R = touch.T_sensor_object[:3, :3].T @ start[:3, :3]
            turned = np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))
            assert turned == pytest.approx(trial.turn_deg, abs=1e-3)
            centre = np.linalg.solve(touch.T_sensor_object, np.append(problem.centre, 1))
            off = 1e3 * (start @ centre)[:2] - 1e3 * problem.centre[:2]
            assert np.linalg.norm(off) == pytest.approx(trial.shift_mm, abs=1e-6)
            assert trial.error_mm == trial.start_mm and trial.drift_mm == pytest.approx(0, abs=1e-9)
        for start, trial in zip(seen["a"][7 * i + 4 :], whole[i][-6::2], strict=False):
            assert trial.turn_deg is None and trial.shift_mm is None
            rotations = grid.directions.rotations()[0]
            assert np.abs(rotations - start[:3, :3]).max((1, 2)).min() < 1e-9
            depth = nut.penetration(start[None])[0]
            assert np.abs(np.array(grid.resolution.penetrations) - depth).min() < 1e-5
    again = list(trials(nut, touches, lambda _: {"a": stay}, grid, CLEAN, 5, (0.0, 5.0), (0.0, 2.0), first=2))
    assert [t.start_mm for t in again[0]] == [t.start_mm for t in whole[2] if t.method == "a"]


def test_a_method_that_loses_to_another_library_is_named():
    def trial(touch, method, error, shift):
        return Trial(touch, "edge", False, method, 0.0, shift, 3, 2.0, error, 0.0, True, 1.0)

    def made(shift, own, other):
        return [
            trial(i, method, error, shift)
            for i in range(20)
            for method, error in (("none", 2.0), ("filterreg", own), ("another", other))
        ]

    figures = summarise([*made(1.0, 2.0, 0.1), *made(2.0, 0.1, 2.0), *made(4.0, 0.1, 0.1)], 0.2)
    assert figures["lost"] == [{"contact": "edge", "turn_deg": 0.0, "shift_mm": 1.0, "to": "another"}]
    rates = [cell["rates"]["filterreg"] for cell in figures["success"]["edge"]]
    assert rates == [0, 1, 1] and figures["methods"]["filterreg"]["success"] == pytest.approx(2 / 3)
    nothing = summarise([Trial(0, "flat", True, "none", 0.0, 0.0, 0, 0.0, 0.0, 0.0, True, 1.0)] * 2, 0.2)
    assert nothing["success"]["flat"] == [] and nothing["methods"]["none"]["success"] is None


def test_figures_from_the_grid_are_shares_of_their_touches():
    """Ten trials from the grid: one gets worse by more than half a pixel, eight of ten truths lie in the 90 % region."""
    levels = np.append(np.linspace(0.1, 0.88, 8), [0.92, 0.99])
    some = [
        Trial(
            i,
            "edge",
            False,
            "filterreg",
            None,
            None,
            3,
            2.0,
            2.3 if i == 0 else 0.5,
            0.01 * i,
            True,
            1.0,
            float(level),
            1.0,
        )
        for i, level in enumerate(levels)
    ]
    figures = summarise(some, 0.25)
    found = figures["from_grid"]["filterreg"]
    assert found["worse"] == pytest.approx(0.1) and found["of_start"] == pytest.approx(0.25)
    assert found["coverage"]["0.9"] == pytest.approx(0.8) and found["agreement"] == 1
    assert figures["drift"]["edge"]["filterreg"]["median_mm"] == pytest.approx(0.045)
    assert figures["methods"] == {} and figures["success"] == {"edge": []}


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_closed_and_face_outwards(name):
    made = SHAPES[name]()
    assert made.is_watertight and made.is_winding_consistent and made.volume > 0


def test_the_thesis_refines_along_the_membrane_only(nut):
    """Mask points to mask points: a shift and a turn in the image's plane, and nothing else, is undone."""
    surface, spread = Surface(*nut.mesh.sample_surface(3000)), Spread(0.1, 1e-3)
    T = touches_of(nut, 1)[0].T_sensor_object
    mask = simulate_mask(nut, T, False)
    seen = Seen(mask, make_problem(mask, SENSOR))
    off = moved(T, [0, 0, 0.03 * seen.problem.length, 0.4e-3, -0.3e-3, 0], seen.problem)
    end = own_methods(nut, surface, spread)["thesis"](seen, off)
    before, after = (motion_of(T, pose, seen.problem) for pose in (off, end.T))
    assert end.converged and np.linalg.norm(after) < 0.5 * np.linalg.norm(before)
    np.testing.assert_allclose((end.T @ se3.inverse(off))[2], [0, 0, 1, 0], atol=1e-9)


def corner(rng, n):
    """Points (3 n, 3) of three faces that meet at right angles in a corner, aslant to the membrane [mm], and their normals."""
    R = se3.exp([0.5, -0.4, 0.2, 0, 0, 0])[:3, :3]
    points, normals = [], []
    for axis in range(3):
        face = rng.uniform(0, 10, (n, 3))
        face[:, axis] = 10.0
        points.append(face)
        normals.append(np.tile(np.eye(3)[axis], (n, 1)))
    return np.concatenate(points) @ R.T, np.concatenate(normals) @ R.T


def observed(points):
    """A problem of points (n, 3) alone."""
    n, none = len(points), np.zeros((0, 3))
    return Problem(
        points, 0 * points, 0 * points, 0 * points, np.full(n, 0.2e-3), np.ones(n), np.zeros(n, int), none, np.zeros(0, int),
        np.array([0.0, 0.0, 1.0]), points.mean(0), length=5e-3, pitch=0.2e-3, sink_std=1e-4,
    )  # fmt: skip


@pytest.mark.parametrize("name", list(peers(Surface(np.eye(3), np.eye(3)), Spread(0.1, 1e-3))))
def test_other_libraries_move_the_object_towards_the_contact(name):
    """The rim is the object's corner; the start pose is off, and comes back."""
    rng = np.random.default_rng(0)
    points, normals = corner(rng, 1500)
    rim = 1e-3 * corner(rng, 60)[0]
    problem = observed(rim)
    method = peers(Surface(1e-3 * points, normals), Spread(0.05, 1e-3))[name]
    start = moved(np.eye(4), 1e-3 * np.array([0.2, -0.1, 0.15, 0.5, -0.4, 0.3]), problem)
    end = method(Seen(np.zeros((2, 2), bool), problem), start)
    before, after = (np.linalg.norm(motion_of(np.eye(4), pose, problem)) for pose in (start, end.T))
    assert end.converged and after < 0.5 * before


def test_the_command_goes_on_and_draws(tmp_path):
    out, plot = tmp_path / "r.json", tmp_path / "r.png"
    words = ["registration", "hex_nut", "--sensor", "gelsight-mini", "--seed", "3"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registration.trials, "__defaults__", ((0.0, 5.0), (0.0, 1.0), 0))
        args = [*words, "--touches", "2", "--out", str(out), "--plot", str(plot)]
        done = CliRunner().invoke(studies, args)
        assert done.exit_code == 0, done.output
        content = json.loads(out.read_text("utf-8"))
        kept = content["parts"]["hex_nut"]["outcomes"]
        out.write_text(
            json.dumps({**content, "parts": {"hex_nut": {**content["parts"]["hex_nut"], "outcomes": kept[:1]}}})
        )
        done = CliRunner().invoke(studies, args)
        assert done.exit_code == 0, done.output
    content = json.loads(out.read_text("utf-8"))
    again = content["parts"]["hex_nut"]["outcomes"]
    assert again[0] == kept[0] and [t["start_mm"] for t in again[1]] == pytest.approx(
        [t["start_mm"] for t in kept[1]], rel=1e-9
    )
    assert content["schema"] == "geomtact/registration/2" and len(content["parts"]["hex_nut"]["outcomes"]) == 2
    assert {"none", "icp", "filterreg", "both", "thesis"} <= set(content["figures"]["methods"])
    assert np.asarray(Image.open(io.BytesIO(plot.read_bytes()))).std() > 5
    refused = CliRunner().invoke(studies, [*words, "--max-poses", "5000"])
    assert refused.exit_code == 2 and "--max-poses" in refused.output
