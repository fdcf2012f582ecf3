"""Laws of choosing the next touch: information distinguishes places, and there is none where all look alike."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from geomtact.cli.next_touch import next_touch as next_touch_command
from geomtact.cli.shell import one_line_errors
from geomtact.contact_space.space import ContactSpace
from geomtact.errors import GeomtactError, InputError, PoseError, UsageError
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.mesh_file import load_mesh
from geomtact.inference.effort import GRID_ALONE
from geomtact.planning.actions import Probe, Touch
from geomtact.planning.draws import draw_places
from geomtact.planning.grid import grid_of_touches
from geomtact.planning.next_touch import (
    LEAST,
    ambiguity,
    discarded,
    evaluate,
    information,
    likelihoods,
    next_touch,
)
from geomtact.se3 import exp, inverse, transform
from geomtact.sensing.noise import MODERATE
from geomtact.sensing.sensor import Sensor
from tools.studies.kitting.fixture import upwards
from tools.studies.next_touch import study as next_touch_study

MM = 1e-3
DOWN = np.diag([1.0, -1.0, -1.0])  # a sensor that looks down
T_MOVED = exp([0.3, -1.2, 0.5, 0.4, -0.1, 0.7])


def shifts(*mm):
    """Poses (2, n, 4, 4) of an object moved without turning, each place given by two equal poses."""
    return np.tile(transform(np.eye(3), MM * np.array(mm, float)), (2, 1, 1, 1))


def pencil_file(folder: Path) -> Path:
    """A pencil along x: a hexagonal body from -50 to 30 mm, 8 mm across its flats, with a tip that ends at 50 mm."""
    turn = np.arange(6) * np.pi / 3
    hexagon = 8 / np.sqrt(3) * np.stack([np.cos(turn), np.sin(turn)], 1)
    ends = [np.column_stack([np.full(6, x), hexagon]) for x in (-50.0, 30.0)]
    path = folder / "pencil.stl"
    trimesh.convex.convex_hull(np.concatenate([*ends, [[50.0, 0, 0]]])).export(path)
    return path


@pytest.fixture(scope="module")
def pencil(tmp_path_factory):
    """The contact pose space of a pencil on a GelSlim."""
    sensor = Sensor.load("gelslim")
    path = pencil_file(tmp_path_factory.mktemp("pencil"))
    return ContactSpace(load_mesh(path, "mm", sensor=sensor), sensor)


@pytest.fixture(scope="module")
def block():
    """A block of 40 x 10 x 10 mm along x, centred, on a GelSight Mini without housing."""
    box = trimesh.creation.box([40 * MM, 10 * MM, 10 * MM])
    mesh = Mesh(box.vertices, box.faces, "block", "m").with_symmetry()
    return ContactSpace(mesh, replace(Sensor.load("gelsight-mini"), housing_depth=None))


@pytest.fixture(scope="module")
def posterior(a_touch, plug):
    return plug.localize(a_touch(plug)[1], effort=GRID_ALONE)


def above(x_mm, y_mm=0.0, z_mm=50.0, travel=0.1):
    """A touch straight down."""
    return Touch(transform(DOWN, MM * np.array([x_mm, y_mm, z_mm])), travel)


# Information and discarded poses, of likelihoods made by hand


def test_information_is_between_nothing_and_the_entropy(rng):
    for n in (2, 7, 40):
        for sharpness in (0.1, 1.0, 10.0):
            likelihood = rng.random((n, n)) ** sharpness + 1e-6
            assert 0 <= information(likelihood) <= np.log(n)
            assert 0 <= discarded(likelihood) <= 1
        assert information(np.ones((n, n))) == 0
        assert information(np.eye(n)) == pytest.approx(np.log(n))


def test_information_of_a_binary_report():
    """Right with probability 1 - e, it separates two places by log 2 less the doubt, in the mean over reports."""
    e = 0.01
    likelihood = np.array([[1 - e, e], [e, 1 - e]])
    assert information(likelihood) == pytest.approx(np.log(2) + np.log(1 - e))
    # what does not depend on the place is a matter of the outcome alone
    assert information(likelihood * [[3.0], [0.2]]) == pytest.approx(information(likelihood))


def test_discarded_is_the_thesis_count():
    """Three of ten places are occupied: found occupied seven are discarded, found free three."""
    occupied = np.arange(10) < 3
    felt = np.stack([occupied, occupied])
    likelihood = likelihoods(felt, np.zeros((2, 10, 0)), np.zeros(0))
    assert discarded(likelihood) == pytest.approx((3 * 7 + 7 * 3) / 100)
    assert information(likelihood) == pytest.approx(-0.3 * np.log(0.3) - 0.7 * np.log(0.7), abs=0.05)


def test_equal_outcomes_are_equally_likely_everywhere(rng):
    shown = np.tile(rng.random((3, 1, 4)), (1, 20, 1))
    likelihood = likelihoods(np.ones((3, 20), bool), shown, np.full(4, 0.1))
    assert np.ptp(likelihood) < 1e-12
    assert information(likelihood) == pytest.approx(0, abs=1e-12)


def test_variation_within_places_is_no_information(rng):
    """The same spread within every place as between them: to the naive all differ, but no place is distinguished."""
    shown = rng.normal(size=(5, 100, 3))
    noise = np.full(3, 1e-3)
    assert information(likelihoods(np.ones((5, 100), bool), shown, noise)) < 0.1
    apart = shown + 100 * rng.normal(size=(1, 100, 3))
    assert information(likelihoods(np.ones((5, 100), bool), apart, noise)) > 3


# Touches and probes of a block


def test_an_action_that_distinguishes_two_places_is_worth_log_2(block):
    """Moved by 8 mm along its length, the block looks the same in the middle and not at its end."""
    poses = shifts([0, 0, 0], [8, 0, 0])
    assert evaluate(block, above(0), poses).expected_nats == pytest.approx(0, abs=1e-6)
    at_the_end = evaluate(block, above(22), poses)
    assert at_the_end.expected_nats == pytest.approx(np.log(2), abs=0.02)
    assert at_the_end.expected_discarded == pytest.approx(0.5)
    # how far the sensor comes is as informative as what it then shows
    from_the_side = Touch(transform(np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]]), [60 * MM, 0, 0]), 0.05)
    assert evaluate(block, from_the_side, poses).expected_nats == pytest.approx(np.log(2), abs=0.02)


def test_a_probe_distinguishes_occupied_from_free(block):
    poses = shifts([0, 0, 0], [8, 0, 0])
    inside = Probe([24 * MM, 0, 0], [0, 0, -1])
    assert evaluate(block, inside, poses).expected_nats == pytest.approx(np.log(2), abs=0.02)
    assert evaluate(block, inside, poses).contact == 0.5
    assert evaluate(block, Probe([24 * MM, 0, 6 * MM], [0, 0, -1]), poses).contact == 0  # ends above the block
    assert evaluate(block, Probe([0, 0, 0], [0, 0, -2]), poses).expected_nats == 0  # occupied at both


def test_symmetric_poses_are_no_information(block):
    """A block turned by half a turn about any of its axes, or by a quarter turn about its length, is the same block."""
    half = [transform(np.diag(d), np.zeros(3)) for d in ([1.0, 1, 1], [1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]
    quarter = transform(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros(3))
    place = transform(np.eye(3), [3 * MM, -2 * MM, 1 * MM])
    poses = np.tile(place @ np.stack([*half, quarter]), (2, 1, 1, 1))
    for action in (above(20, 3), above(-1, 4), Probe([22 * MM, 0, 0], [0, 1, 1]), Touch(T_MOVED, 1.0)):
        assert evaluate(block, action, poses).expected_nats == pytest.approx(0, abs=1e-6)


def test_a_sensor_stops_where_the_object_presses(block):
    pressed = 1 * MM
    T = transform(np.eye(3), [0, 0, 0])[None]
    stopped = above(2).reached(block, T, pressed)[0]
    assert stopped[:3, 3] == pytest.approx([2 * MM, 0, 4 * MM], abs=1e-6)  # the block's top is at 5 mm
    assert block.caster.penetration(block.sensor, inverse(stopped) @ T)[0] == pytest.approx(pressed, abs=1e-6)
    assert above(2, travel=0.02).reached(block, T, pressed)[0, 2, 3] == pytest.approx(30 * MM)  # in the air
    assert above(40).reached(block, T, pressed)[0, 2, 3] == pytest.approx(-50 * MM)  # beside the block


def test_a_placed_sensor_touches_the_object_there(block):
    poses = shifts([0, 0, -0.5], [0, 0, 0.5])  # tops at 4.5 and 5.5 mm
    assert evaluate(block, above(0, z_mm=5, travel=0.0), poses).contact == 0.5
    assert evaluate(block, above(0, z_mm=5, travel=0.0), poses).expected_nats == pytest.approx(np.log(2), abs=0.02)


def test_a_housing_that_strikes_first_shows_nothing(block):
    """Beside a step that is higher than the housing is deep, the gel does not come down to the lower face."""
    low = trimesh.creation.box([60 * MM, 10 * MM, 10 * MM])
    high = trimesh.creation.box([20 * MM, 10 * MM, 30 * MM])
    high.apply_translation([20 * MM, 0, 10 * MM])
    step = trimesh.boolean.union([low, high])
    mesh = Mesh(step.vertices, step.faces, "step", "m").with_symmetry()
    bare = ContactSpace(mesh, block.sensor)
    housed = ContactSpace(mesh, replace(block.sensor, housing_depth=3 * MM))
    poses, on_the_low_face = shifts([0, 0, 0], [1, 0, 0]), above(-8)
    assert evaluate(bare, on_the_low_face, poses).contact == 1
    assert evaluate(housed, on_the_low_face, poses).contact == 0
    assert evaluate(housed, above(20), poses).contact == 1


# The thesis's pencil (figures 16 and 17)


def test_the_pencil_is_constrained_at_its_ends(pencil):
    """Held at a place where it looks the same all along, a pencil may be shifted and reversed."""
    there = [transform(np.eye(3), [x * MM, 0, 0]) for x in (-6, -2, 2, 6)]
    turned = [T @ transform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)) for T in there]
    poses = np.tile(np.stack(there + turned), (2, 1, 1, 1))
    right, left = np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]]), np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]])
    actions = [
        above(0),
        Touch(transform(right, [0.1, 0, 0]), 0.1),
        Touch(transform(left, [-0.1, 0, 0]), 0.1),
        above(46),
        Probe([50 * MM, 0, 0], [0, 0, -1]),
        Probe([0, 0, 0], [0, 0, -1]),
    ]
    side, *ends, tip_from_above, finger_at_the_end, finger_in_the_middle = (evaluate(pencil, a, poses) for a in actions)
    assert side.expected_nats < LEAST
    assert finger_in_the_middle.expected_nats == 0
    for end in ends:
        assert end.expected_nats > 0.9 * np.log(8)  # how far the sensor comes and its contact distinguish all eight
    assert tip_from_above.expected_nats > 0.7
    assert 0.4 < finger_at_the_end.expected_nats < np.log(2)
    assert "same" in ambiguity([side, finger_in_the_middle])
    assert ambiguity([side, *ends]) is None


@pytest.fixture(scope="module")
def on_a_facet(make_localizer, tmp_path_factory):
    """A pencil that is touched on one of its facets or the opposite one; and R (3, 3) that lays that facet on the sensor."""
    mesh = load_mesh(pencil_file(tmp_path_factory.mktemp("pencil")), "mm")
    facet = mesh.normals[np.argmax(mesh.areas)]
    R = np.linalg.svd(facet[None])[2]
    R = np.stack([R[1], np.cross(-facet, R[1]), -facet])
    return make_localizer(mesh, "gelslim", approach=[(facet, 0.0), (-facet, 0.0)], max_poses=10_000), R


@pytest.mark.slow
def test_after_a_touch_on_its_side_a_pencil_is_touched_at_an_end(on_a_facet):
    """From the posterior of a simulated touch, with the facets as contact faces."""
    localizer, R = on_a_facet
    T, _ = localizer.space.settle(transform(R, np.zeros(3)), 1 * MM)
    posterior = localizer.localize(localizer.simulate(T[0]).mask, T_world_sensor=np.eye(4))
    axis = R @ [1.0, 0, 0]
    centre = T[0][:3, 3]

    def towards(direction, where):
        """A touch that comes along ``direction`` and passes through ``where``."""
        other = [0.0, 0, 1] if abs(direction[2]) < 0.9 else axis
        x = np.cross(other, direction)
        x /= np.linalg.norm(x)
        return Touch(transform(np.stack([x, np.cross(direction, x), direction], 1), where - 0.12 * direction), 0.2)

    ends = [towards(s * axis, centre) for s in (1, -1)]
    down = np.array([0.0, 0, -1])
    sides = [towards(down, centre + s * MM * axis) for s in (-8, 0, 8)]
    ranked = next_touch(posterior, [*sides, *ends], n=64)
    assert {a.number for a in ranked[:2]} == {4, 5}
    assert ranked[1].expected_nats > 1.3 * ranked[2].expected_nats


# The choice


def test_ranked_by_nats_for_the_cost_and_the_same_for_the_same_seed(posterior):
    touches = grid_of_touches(posterior)[:8]
    ranked = next_touch(posterior, touches, n=32)
    gains = [a.expected_nats for a in ranked]
    assert gains == sorted(gains, reverse=True)
    assert 0 < gains[0] <= np.log(32)
    again = next_touch(posterior, touches, n=32)
    assert [(a.number, a.expected_nats) for a in again] == [(a.number, a.expected_nats) for a in ranked]
    best = ranked[0].number
    assert ranked[0].of is touches[best - 1]
    dear = next_touch(posterior, [replace(t, cost=1e3) if i == best else t for i, t in enumerate(touches, 1)], n=32)
    place = [a.number for a in dear].index(best)
    assert dear[place].cost == 1e3 and all(a.expected_nats <= 1e-3 * gains[0] for a in dear[place + 1 :])


def test_ties_keep_the_order_given(posterior):
    away = Touch(transform(np.eye(3), [5.0, 0, 0]), 0.01)
    touches = grid_of_touches(posterior)
    near = touches[next_touch(posterior, touches, n=32)[0].number - 1]  # the most informative one
    ranked = next_touch(posterior, [away, near, away, near], n=32)
    assert [a.number for a in ranked] == [2, 4, 1, 3]
    assert ranked[2].expected_nats == 0
    assert "hardly any" in ambiguity(ranked[2:])
    assert ambiguity(ranked) is None


def test_the_choice_does_not_depend_on_the_frame(plug, a_touch, posterior):
    """The world moved together with all actions changes nothing."""
    world = plug.localize(a_touch(plug)[1], T_world_sensor=T_MOVED, effort=GRID_ALONE)
    touches = grid_of_touches(posterior)[:4]
    moved = [Touch(T_MOVED @ t.T_world_sensor, t.travel) for t in touches]
    here, there = next_touch(posterior, touches, n=32), next_touch(world, moved, n=32)
    for a, b in zip(here, there, strict=True):
        assert a.number == b.number
        assert a.expected_nats == pytest.approx(b.expected_nats, abs=0.05)
        assert b.T_world_sensor == pytest.approx(T_MOVED @ a.T_world_sensor)


def test_cells_are_drawn_by_their_probability(plug, posterior, rng):
    sharp = replace(posterior, cells=posterior.cells[:3], cell_log_prob=np.log([0.5, 0.5, 1e-12]))
    T = draw_places(sharp, 20, rng, 5)
    assert T.shape == (5, 20, 4, 4)
    held = plug.index.lookup(T.reshape(-1, 4, 4), plug.space.penetration(T.reshape(-1, 4, 4)))
    assert set(held.reshape(5, 20)[0]) <= set(posterior.cells[:2])
    assert (held.reshape(5, 20) == held.reshape(5, 20)[0]).mean() > 0.9


def test_touches_start_clear_of_the_object_and_meet_it(plug, posterior):
    touches = grid_of_touches(posterior)
    assert len(touches) >= 17
    T = draw_places(posterior, 32, np.random.default_rng(0), 2)
    assert all(evaluate(plug.space, replace(t, travel=0.0), T).contact < 0.1 for t in touches[::4])
    assert np.mean([evaluate(plug.space, t, T).contact for t in touches[::4]]) > 0.5
    assert all(t.T_world_sensor[2, 2] < 0.1 for t in touches)  # none comes from the first sensor's side
    low = grid_of_touches(posterior, reachable=lambda T: T[2, 3] < 20 * MM)
    assert 0 < len(low) < len(touches)
    again = grid_of_touches(posterior, made=[t.T_world_sensor for t in touches[::2]])
    assert len(again) < len(touches)
    beside = grid_of_touches(posterior, side=[1, 0, 0])
    assert all(t.T_world_sensor[0, 2] < 0.1 for t in beside)


def test_touches_keep_to_the_approach(flat_nut, a_touch):
    posterior = flat_nut.localize(a_touch(flat_nut)[1], T_world_sensor=T_MOVED, effort=GRID_ALONE)
    touches = grid_of_touches(posterior)
    assert touches
    for touch in touches:
        assert touch.T_world_sensor[:3, 2] == pytest.approx(T_MOVED[:3, 2], abs=1e-5)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: Touch(2 * np.eye(4)), "rotation"),
        (lambda: Touch(np.eye(3)), "T_world_sensor"),
        (lambda: Touch(np.stack([np.eye(4)] * 2)), "one pose"),
        (lambda: Touch(np.eye(4), travel=-1.0), "travel"),
        (lambda: Touch(np.eye(4), cost=0.0), "cost"),
        (lambda: Probe([0, 0, np.nan], [0, 0, 1]), "point"),
        (lambda: Probe([0, 0, 0], [0, 0, 0]), "direction"),
        (lambda: Probe([0, 0, 0], [0, 0, 1], cost=np.inf), "cost"),
    ],
)
def test_impossible_actions_are_refused(make, expected):
    with pytest.raises(GeomtactError, match=expected):
        make()


def test_a_choice_needs_contact_and_actions(plug, posterior):
    nothing = plug.localize(np.zeros(plug.sensor.image_size_px[::-1], bool))
    for choose in (next_touch, grid_of_touches):
        with pytest.raises(InputError, match="without contact"):
            choose(nothing)
    with pytest.raises(UsageError, match="no actions"):
        next_touch(posterior, [])
    with pytest.raises(PoseError, match="T_world_sensor"):
        next_touch(posterior, [np.ones((4, 4))])
    assert next_touch(posterior, [np.eye(4)], n=16)[0].of.travel == 0


# The command


@pytest.fixture(scope="module")
def saved(posterior, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "posterior.npz"
    posterior.save(path)
    return path


@pytest.fixture
def command(cache_dir, monkeypatch):
    """Runs ``next-touch``; checks the exit status."""
    import typer

    monkeypatch.setenv("GEOMTACT_CACHE", str(cache_dir))
    app = typer.Typer()
    app.command()(one_line_errors(next_touch_command))

    def run(*args, status=0):
        result = CliRunner().invoke(app, [str(a) for a in args])
        assert result.exit_code == status, f"exit status {result.exit_code}: {result.output} {result.exception!r}"
        if status:
            assert result.stderr.startswith("error: ")
            assert result.stderr.count("\n") == 1
        return result

    return run


def test_command_ranks_the_actions_of_a_file(command, saved, tmp_path):
    file, out = tmp_path / "actions.json", tmp_path / "out"
    free = transform(np.eye(3), [3.0, 0, 0])
    reaching = transform(DOWN, [0, 0, 0.15])
    actions = [
        {"T_world_sensor": free.tolist(), "cost": 2.0},
        {"T_world_sensor": reaching.tolist(), "travel": 0.15},
        {"probe": {"point": [0, 0, 0.01], "direction": [0, 0, -1]}},
    ]
    file.write_text(json.dumps({"actions": actions}))
    printed = command(saved, "--actions", file, "--out", out).stdout
    assert "nats" in printed
    content = json.loads((out / "next_touch.json").read_text())
    assert content["schema"] == "geomtact/next-touch/1"
    assert content["actions"][0]["number"] in (2, 3)
    place = [action["number"] for action in content["actions"]].index(1)
    # a probe may be worth nothing, too
    assert all(action["expected_nats"] == 0 for action in content["actions"][place:])
    assert content["actions"][place]["T_world_sensor"] == free.tolist()
    assert content["actions"][place]["cost"] == 2
    assert {a["kind"] for a in content["actions"]} == {"touch", "probe"}
    assert content["note"] is None
    assert (out / "next_touch.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_prints_that_no_action_helps(command, saved, tmp_path):
    file = tmp_path / "actions.json"
    file.write_text(json.dumps({"actions": [{"T_world_sensor": transform(np.eye(3), [3.0, 0, 0]).tolist()}]}))
    content = json.loads(command(saved, "--actions", file, "--json").stdout)
    assert "stays as uncertain" in content["note"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "JSON"),
        ("[]", "actions"),
        ('{"actions": []}', "no actions"),
        ('{"actions": [{"cost": 1}]}', "action 1"),
        ('{"actions": [{"T_world_sensor": [[1, 2], [3]]}]}', "action 1"),
        (json.dumps({"actions": [{"T_world_sensor": (2 * np.eye(4)).tolist()}]}), "action 1.*rotation"),
        (json.dumps({"actions": [{"T_world_sensor": np.eye(4).tolist(), "costs": 1}]}), "costs"),
        ('{"actions": [{"probe": {"point": [0, 0, 0]}}]}', "direction"),
        (json.dumps({"actions": [{"T_world_sensor": np.eye(4).tolist(), "cost": "x"}]}), "numbers"),
    ],
)
def test_command_refuses_bad_files(command, saved, tmp_path, text, expected):
    import re

    file = tmp_path / "actions.json"
    file.write_text(text)
    error = command(saved, "--actions", file, status=3).stderr
    assert re.search(expected, error), error
    assert "actions.json" in error


def test_the_command_refuses_a_file_without_a_posterior_or_contact(command, plug, tmp_path):
    assert "no such file" in command(tmp_path / "nowhere.npz", status=3).stderr
    nothing = tmp_path / "nothing.npz"
    plug.localize(np.zeros(plug.sensor.image_size_px[::-1], bool)).save(nothing)
    assert "without contact" in command(nothing, status=3).stderr
    assert "no such file" in command(nothing, "--actions", tmp_path / "nowhere.json", status=3).stderr


# The study


@pytest.mark.slow
def test_touching_until_sure_starts_alike_and_stops_when_sure(flat_nut, monkeypatch):
    monkeypatch.setattr(next_touch_study, "MOST", 1)
    ((best, random),) = next_touch_study.touch_until_sure(flat_nut, 1, 3, MODERATE)
    assert (best.policy, random.policy) == next_touch_study.POLICIES
    assert best.gains[0] == random.gains[0]
    for run in (best, random):
        assert 0 <= run.touches <= 1
        assert run.probability >= next_touch_study.SURE or run.touches == 1


def test_figures_of_runs_made_by_hand():
    def run(scene, policy, touches, probability=0.97, mssd_mm=1.0):
        return next_touch_study.Run(scene, policy, touches, probability, mssd_mm, [0.0])

    runs = [run(0, "best", 1), run(1, "best", 2, mssd_mm=30.0), run(0, "random", 2), run(1, "random", 10, 0.5)]
    figures = next_touch_study.summarise(runs)
    assert figures["best"]["touches_mean"] == 1.5
    assert figures["random"]["sure"] == 0.5
    assert figures["best"]["wrong"] == 0.5
    assert figures["best"]["sure_after"][:3] == [0.0, 0.5, 1.0]
    ratio, low, high = figures["ratio"]
    assert ratio == pytest.approx(0.25) and low <= ratio <= high


@pytest.mark.parametrize("name", ["connector_plug", "bracket"])
def test_an_object_lies_on_its_lowest_face(name):
    mesh = load_mesh(name)
    up = upwards(mesh)
    assert np.linalg.norm(up) == pytest.approx(1)
    # lying on a facet: three of its corners, at least, are down
    height = mesh.vertices @ up
    assert (height < height.min() + 1e-6).sum() >= 3
