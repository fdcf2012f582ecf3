"""Registration judged: what a contact tells is what the simulator says, and every method starts where the others do."""

import io
import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from geomtact import load_mesh, se3
from geomtact.cli import app
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import felt_mask
from geomtact.evaluation import registration
from geomtact.evaluation.information import fisher_information, told_directions
from geomtact.evaluation.peers import peers
from geomtact.evaluation.registration import Trial, summarise, trials
from geomtact.evaluation.touches import random_touches
from geomtact.registration.observability import Spread, motion_of, moved
from geomtact.registration.protocol import Problem, Surface
from geomtact.registration.rim import make_problem
from geomtact.sensing.noise import CLEAN, MODERATE, Noise
from geomtact.sensing.sensor import Sensor

SENSOR = Sensor("small", (120, 90), (0.15e-3, 0.15e-3), 0.0, 2e-3)


@pytest.fixture(scope="module")
def ball():
    return ContactSpace(load_mesh("ball").with_symmetry(), SENSOR)


@pytest.fixture(scope="module")
def nut():
    return ContactSpace(load_mesh("hex_nut").with_symmetry(), SENSOR)


def stay(problem, start):
    return start, True


def touches_of(space, n, elastic=None, noise=CLEAN):
    return random_touches(SimpleNamespace(space=space), n, 3, elastic, noise)


def pressed_in_the_middle(space, depth=0.8e-3):
    """A pose (4, 4) of the part, unturned, with its middle above the window's."""
    T = np.eye(4)
    T[:3, 3] = [0.7e-3, -0.4e-3, 20e-3] - space.mesh.centre
    settled, ok = space.settle(T[None], depth)
    assert ok[0]
    return settled[0]


@pytest.mark.parametrize("elastic", [False, True])
def test_a_ball_tells_where_it_is_and_not_how_it_is_turned(ball, elastic):
    T = pressed_in_the_middle(ball)
    problem = make_problem(felt_mask(ball, T, elastic), SENSOR)
    told, rest = told_directions(fisher_information(ball, T, elastic, problem, MODERATE), 0.2e-3)
    assert len(told) == 3 and np.allclose(np.vstack([told, rest]) @ np.vstack([told, rest]).T, np.eye(6))
    centre = T @ np.append(ball.mesh.centre, 1)
    for axis in np.eye(3):
        # a turn about the contact's centre that is undone by a shift leaves the ball where it is
        zeta = np.append(axis * problem.length, np.cross(axis, problem.centre - centre[:3]))
        zeta /= np.linalg.norm(zeta)
        assert np.linalg.norm(told @ zeta) < 0.15


def test_information_is_that_of_the_outline(ball):
    """A disk of radius a shifted along x moves its outline by the cosine of the normal, which is a half in mean square: pi a
    over the noise's correlation is told, per noise variance; to a fifth, at such pixels."""
    T = pressed_in_the_middle(ball)
    mask = felt_mask(ball, T, False)
    problem = make_problem(mask, SENSOR)
    radius = np.sqrt(mask.sum() * SENSOR.pixel_area(mask.shape) / np.pi)
    noise = Noise(outline_rms=0.2e-3, correlation=(1e-3, 3e-3))
    found = fisher_information(ball, T, False, problem, noise, pixel_noise=0.0)
    expected = np.pi * radius / 2e-3 / 0.2e-3**2
    assert np.diag(found)[3:5] == pytest.approx(expected, rel=0.2)


def test_a_touch_that_nothing_moves_tells_nothing(nut):
    told, rest = told_directions(np.zeros((6, 6)), 1e-3)
    assert told.shape == (0, 6) and rest.shape == (6, 6)


def test_every_method_starts_where_the_others_do_and_as_far_off_as_said(nut):
    touches = touches_of(nut, 3)
    seen = {"a": [], "b": []}

    def spying(name):
        def method(problem, start):
            seen[name].append(start)
            return start, True

        return method

    methods = {name: spying(name) for name in seen}
    whole = list(trials(nut, touches, methods, 2e-3, CLEAN, 5, turns_deg=(0.0, 5.0), shifts_mm=(0.0, 2.0)))
    assert [len(some) for some in whole] == [8, 8, 8]
    np.testing.assert_array_equal(seen["a"], seen["b"])
    for i, touch in enumerate(touches):
        problem = make_problem(touch.mask, SENSOR)
        for start, trial in zip(seen["a"][4 * i :], whole[i][::2], strict=False):
            R = touch.T_sensor_object[:3, :3].T @ start[:3, :3]
            turned = np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))
            assert turned == pytest.approx(trial.turn_deg, abs=1e-3)
            centre = np.linalg.solve(touch.T_sensor_object, np.append(problem.centre, 1))
            off = 1e3 * (start @ centre)[:2] - 1e3 * problem.centre[:2]
            assert np.linalg.norm(off) == pytest.approx(trial.shift_mm, abs=1e-6)
            assert trial.error_mm == trial.start_mm and trial.drift_mm == pytest.approx(0, abs=1e-9)
    again = list(trials(nut, touches, {"a": stay}, 2e-3, CLEAN, 5, (0.0, 5.0), (0.0, 2.0), first=2))
    assert [t.start_mm for t in again[0]] == [t.start_mm for t in whole[2] if t.method == "a"]


def test_who_loses_to_another_library_is_said():
    def trial(touch, method, error, shift):
        return Trial(touch, "edge", False, method, 0.0, shift, 3, 2.0, error, 0.0, True, 1.0)

    def made(shift, own, other):
        return [
            trial(i, method, error, shift)
            for i in range(20)
            for method, error in (("none", 2.0), ("filterreg", own), ("another", other))
        ]

    figures = summarise([*made(1.0, 2.0, 0.1), *made(2.0, 0.1, 2.0), *made(4.0, 0.1, 0.1)])
    assert figures["lost"] == [{"contact": "edge", "turn_deg": 0.0, "shift_mm": 1.0, "to": "another"}]
    rates = [cell["rates"]["filterreg"] for cell in figures["success"]["edge"]]
    assert rates == [0, 1, 1] and figures["methods"]["filterreg"]["success"] == pytest.approx(2 / 3)
    nothing = summarise([Trial(0, "flat", True, "none", 0.0, 0.0, 0, 0.0, 0.0, 0.0, True, 1.0)] * 2)
    assert nothing["success"]["flat"] == [] and nothing["methods"]["none"]["success"] is None


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
        points.mean(0), length=5e-3, pitch=0.2e-3, sink_std=1e-4,
    )  # fmt: skip


@pytest.mark.parametrize("name", list(peers(Surface(np.eye(3), np.eye(3)), Spread(0.1, 1e-3))))
def test_other_libraries_move_the_object_the_right_way(name):
    """The rim is the object's corner; the start pose is off, and comes back."""
    rng = np.random.default_rng(0)
    points, normals = corner(rng, 1500)
    rim = 1e-3 * corner(rng, 60)[0]
    problem = observed(rim)
    method = peers(Surface(1e-3 * points, normals), Spread(0.05, 1e-3))[name]
    start = moved(np.eye(4), 1e-3 * np.array([0.2, -0.1, 0.15, 0.5, -0.4, 0.3]), problem)
    T, converged = method(problem, start)
    before, after = (np.linalg.norm(motion_of(np.eye(4), pose, problem)) for pose in (start, T))
    assert converged and after < 0.5 * before


def test_the_command_goes_on_and_draws(tmp_path):
    out, plot = tmp_path / "r.json", tmp_path / "r.png"
    words = ["evaluate", "registration", "hex_nut", "--sensor", "gelsight-mini", "--seed", "3"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registration.trials, "__defaults__", ((0.0, 5.0), (0.0, 1.0), 0))
        args = [*words, "--touches", "2", "--out", str(out), "--plot", str(plot)]
        done = CliRunner().invoke(app, args)
        assert done.exit_code == 0, done.output
        content = json.loads(out.read_text("utf-8"))
        kept = content["parts"]["hex_nut"]["outcomes"]
        out.write_text(
            json.dumps({**content, "parts": {"hex_nut": {**content["parts"]["hex_nut"], "outcomes": kept[:1]}}})
        )
        done = CliRunner().invoke(app, args)
        assert done.exit_code == 0, done.output
    content = json.loads(out.read_text("utf-8"))
    again = content["parts"]["hex_nut"]["outcomes"]
    assert again[0] == kept[0] and [t["start_mm"] for t in again[1]] == pytest.approx(
        [t["start_mm"] for t in kept[1]], rel=1e-9
    )
    assert content["schema"] == "geomtact/registration/1" and len(content["parts"]["hex_nut"]["outcomes"]) == 2
    assert {"none", "icp", "filterreg", "both"} <= set(content["figures"]["methods"])
    assert np.asarray(Image.open(io.BytesIO(plot.read_bytes()))).std() > 5
    refused = CliRunner().invoke(app, [*words, "--max-poses", "5000"])
    assert refused.exit_code == 2 and "--max-poses" in refused.output
