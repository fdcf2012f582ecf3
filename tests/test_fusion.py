"""Several sensors at once: products, shares of cells, sensors without contact, and sensors that disagree."""

import functools
import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from speed import slow_but
from typer.testing import CliRunner

from geomtact import Localizer, Mesh, se3
from geomtact.cli import app
from geomtact.contact_space.cell_transfer import CellTransfer, ExtrinsicsStd
from geomtact.contact_space.touches import random_touches
from geomtact.errors import InputError, NoPoseAgreesError, UsageError
from geomtact.evaluation import simultaneous_touches
from geomtact.inference.distribution import cell_densities, cell_log_density
from geomtact.inference.effort import GRID_ALONE
from geomtact.inference.extrinsics import extrinsics_covariance
from geomtact.inference.fusion import _shares, disagreement, fuse, poor_agreement
from geomtact.sensing.image_file import write_image
from geomtact.sensing.reading import read_observation


def world(touches, rng):
    """A random pose of the object in the world, and those of the sensors that ``touches`` names as in contact."""
    T = se3.transform(se3.random_rotations(1, rng)[0], rng.uniform(-0.2, 0.2, 3))
    return T, np.stack([T @ se3.inverse(touch.T_sensor_object) for touch in touches])


def single(localizer, touch, T):
    return localizer.localize(touch.mask, "mask", T_world_sensor=T, effort=GRID_ALONE)


@pytest.fixture(scope="module")
def carried(plug):
    """Pairs of sensors that touch: places of poses drawn within cells of the first, and poses at the second."""
    index, space = plug.index, plug.space

    @functools.cache
    def of(pairs):
        found, rng = [], np.random.default_rng(0)
        T, _ = space.sample(2 * pairs, rng)
        for here, there in zip(T[::2], T[1::2], strict=True):
            transfer = CellTransfer(index, index, there @ se3.inverse(here))
            cells = rng.choice(index.possible, 400)
            settled, ok = space.settle(*index.draw(cells, rng))
            found.append((transfer, cells[ok] % index.places, transfer.T_there_here @ settled[ok]))
        return found

    return of


def test_a_sensor_in_the_same_place_sees_each_place_in_itself(plug):
    """A place carried by the identity lies in itself: its height is uncertain by the grid's step, so that it keeps a share,
    never more than all; and of the other sensor at most that place and its neighbours are looked up."""
    index = plug.index
    transfer = CellTransfer(index, index, np.eye(4))
    share = transfer.shares().sum(0)
    assert (share > 0).mean() > 0.99 and share.max() <= 1 + 1e-6
    only = np.zeros(index.height.shape, np.float32)
    place = int(transfer.mean(np.ones(len(index)))[1].argmax())
    only[:, place] = 1
    seen = transfer.mean(only)[0]
    assert seen.argmax() == place and seen[index.rotation != index.rotation[place]].max() < 0.05 * seen.max()


@pytest.mark.parametrize("pairs", slow_but((6, 12), 6))
def test_shares_equal_the_frequencies_of_simulation(plug, carried, pairs):
    """Of poses drawn within cells, as many touch a second sensor as the cells' shares predict, within a factor of two."""
    expected, happened = [], []
    for transfer, places, T in carried(pairs):
        expected.append(transfer.mean(np.ones(len(plug.index)))[1][places].mean())
        happened.append(np.isfinite(plug.space.penetration(T)).mean())
    assert 0.5 < np.mean(expected) / np.mean(happened) < 2.0


@pytest.mark.parametrize("pairs", slow_but((6, 12), 6))
def test_sensors_without_contact_are_reached_at_the_stated_frequency(plug, carried, pairs):
    """Of poses drawn within cells, about as many reach a second sensor, at any depth, as the shares predict.

    Over five draws of 12 pairs the shares predict 0.79 of them with a standard deviation of 0.03, of 6 pairs 0.78 with 0.07.
    """
    expected, happened = [], []
    for transfer, places, T in carried(pairs):
        expected.append(transfer.reached()[places])
        happened.append(plug.space.caster.penetration(plug.sensor, T) > 0)
    expected, happened = np.concatenate(expected), np.concatenate(happened)
    assert 0.6 < expected.mean() / happened.mean() < 1.4
    assert expected.max() <= 1 + 1e-6
    assert ((expected - happened) ** 2).mean() < 0.7 * happened.var()


def test_more_uncertain_extrinsics_spread_the_shares(plug, rng):
    T, _ = plug.space.sample(2, rng)
    carried = T[1] @ se3.inverse(T[0])
    exact, loose = (
        CellTransfer(plug.index, plug.index, carried, rig) for rig in (ExtrinsicsStd(), ExtrinsicsStd(0.05, 5e-3))
    )
    lever = np.linalg.norm(carried[:3, 3])
    assert loose.std**2 == pytest.approx(exact.std**2 + (5e-3) ** 2 + (0.05 * lever) ** 2)
    sharp, wide = (transfer.mean(np.ones(len(plug.index)))[1].astype(float) for transfer in (exact, loose))
    # how many places have the most of it
    assert wide.sum() ** 2 / (wide**2).sum() > 1.03 * sharp.sum() ** 2 / (sharp**2).sum()


def test_a_pose_outside_the_approach_does_not_touch(flat_nut):
    """A nut that lies on its face never touches a sensor that looks at it from the side."""
    side = se3.transform(se3.exp([np.pi / 2, 0, 0, 0, 0, 0])[:3, :3], np.zeros(3))
    transfer = CellTransfer(flat_nut.index, flat_nut.index, side)
    assert transfer.mean(np.ones(len(flat_nut.index)))[1].max() == 0


def test_doubtful_places_are_carried_roughly_but_without_bias(plug, rng):
    T, _ = plug.space.sample(32, rng)
    density, places = np.ones(len(plug.index)), plug.index.places
    some = rng.random(places) < 0.5
    sums = []
    for here, there in zip(T[::2], T[1::2], strict=True):
        transfer = CellTransfer(plug.index, plug.index, there @ se3.inverse(here))
        exact, rough, mixed = (transfer.mean(density, doubtful)[1] for doubtful in (None, np.ones(places, bool), some))
        np.testing.assert_array_equal(mixed, np.where(some, rough, exact))
        sums.append((exact.sum(), rough.sum()))
    exact, rough = np.sum(sums, 0)
    assert rough == pytest.approx(exact, rel=0.1)


def test_sensors_with_the_same_errors_count_as_one(rng):
    log_prior, fields = np.full(5000, -np.log(5000.0)), rng.normal(size=(3, 5000))
    three = np.ones(3, bool)
    # distinguished by their measurements, they count all but in full, as do sensors without contact
    np.testing.assert_allclose(_shares(log_prior, fields, three), 1 / 1.2, atol=0.03)
    np.testing.assert_allclose(_shares(log_prior, fields[[0, 0, 0]], three), 1 / 3, atol=1e-6)
    np.testing.assert_allclose(_shares(log_prior, fields[[0, 1, 0]], three), 1 / np.array([2.1, 1.2, 2.1]), atol=0.05)
    np.testing.assert_allclose(
        _shares(log_prior, fields[[0, 0, 1]], three & [True, False, True]), [1 / 1.1, 1, 1 / 1.1], atol=0.03
    )
    # what is impossible, and where a scale is, does not matter
    fields[0, :2500] = -np.inf
    np.testing.assert_allclose(_shares(log_prior, 1e-3 * fields + 7, three), _shares(log_prior, 1e-3 * fields, three))


@pytest.mark.parametrize("scenes", slow_but((2, 12), 2))
def test_each_further_sensor_adds_information_about_the_true_pose(plug, scenes):
    """On the cells alone, without what is found within them."""
    gains = []
    touches = random_touches(plug.space, 3 * scenes, 3)
    for i in range(scenes):
        rng = np.random.default_rng(i)
        some = touches[3 * i : 3 * i + 3]
        T, sensors = world(some, rng)
        for n in (1, 2, 3):
            posterior = plug.localize([t.mask for t in some[:n]], "mask", None, sensors[:n], effort=GRID_ALONE, seed=i)
            assert posterior.frame == "world" and len(posterior.observations) == n
            assert np.exp(posterior.log_prob).sum() == pytest.approx(1, abs=1e-4)
            gains.append(posterior.log_density(T))
            for mode in posterior.modes(3):
                assert np.isfinite(posterior.log_density(mode.T))
    gains = np.reshape(gains, (scenes, 3))
    assert np.isfinite(gains).all()
    more = (gains - gains[:, :1]).mean(0)
    assert 0 < more[1] < more[2]


def test_the_order_of_the_others_changes_nothing_and_the_world_is_anywhere(plug):
    touches = random_touches(plug.space, 3, 5)
    _, sensors = world(touches, np.random.default_rng(0))
    alone = [single(plug, touch, T) for touch, T in zip(touches, sensors, strict=True)]
    straight, swapped = fuse(alone), fuse([alone[0], alone[2], alone[1]])
    np.testing.assert_allclose(straight.log_prob, swapped.log_prob, atol=1e-5)
    np.testing.assert_allclose(straight.support, swapped.support[[0, 2, 1]], atol=1e-5)
    elsewhere = se3.transform(se3.exp([0.4, 1.0, -2.0, 0, 0, 0])[:3, :3], [0.5, -0.2, 1.0])
    moved = fuse([single(plug, touch, elsewhere @ T) for touch, T in zip(touches, sensors, strict=True)])
    np.testing.assert_allclose(straight.log_prob, moved.log_prob, atol=1e-2)


def test_a_sensor_without_contact_lowers_poses_that_would_touch_it(plug, rng):
    touch = random_touches(plug.space, 1, 7)[0]
    T, sensors = world([touch], rng)
    # a sensor at the object's other side, and one far away
    back = np.diag([1.0, -1.0, -1.0, 1.0])
    centre = T @ se3.transform(np.eye(3), plug.mesh.centre)
    near = sensors[0].copy()
    near[:3, 3] = 2 * centre[:3, 3] - sensors[0][:3, 3]
    near = near @ back
    far = se3.transform(np.eye(3), [0, 0, 1.0]) @ near
    empty = np.zeros_like(touch.mask)
    alone = single(plug, touch, sensors[0])
    beside, away = (
        plug.localize([touch.mask, empty], "mask", None, np.stack([sensors[0], other]), effort=GRID_ALONE)
        for other in (near, far)
    )
    before = cell_densities(alone)
    assert np.abs(np.log(cell_densities(away)[before > 0] / before[before > 0])).max() < 1e-3
    ratio = np.log(cell_densities(beside)[before > 0] / before[before > 0])
    share = np.tile(
        CellTransfer(plug.index, plug.index, se3.inverse(near) @ sensors[0]).reached(),
        len(plug.index.height),
    )[before > 0]
    # the more of a cell would touch, the less of it is left
    assert np.corrcoef(share, ratio)[0, 1] < -0.9 and ratio[share.argmin()] > 0 > ratio[share.argmax()]


def test_a_contact_that_is_not_found_in_an_image_is_warned_of(plug, rng):
    """An empty mask says that nothing touches; an image may hide a contact."""
    touch = random_touches(plug.space, 1, 7)[0]
    _, sensors = world([touch], rng)
    both = np.stack([sensors[0], se3.transform(np.eye(3), [0, 0, 1.0]) @ sensors[0]])
    grey, empty = rng.integers(100, 140, (*touch.mask.shape, 3), np.uint8), np.zeros_like(touch.mask)
    shown = read_observation(touch.mask, plug.sensor, "mask")
    for other, warned in (
        (read_observation(grey, plug.sensor, "reading", grey), True),
        (read_observation(empty, plug.sensor, "mask"), False),
    ):
        warnings = plug.localize([shown, other], "auto", None, both, effort=GRID_ALONE).warnings
        assert any(w.startswith("sensor 2: no contact was found") for w in warnings) == warned


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (3, 4, 0, 1, 2), (0, 3, 1, 4, 2)])
@pytest.mark.slow
def test_sensors_out_of_reach_do_not_change_the_posterior(plug, order):
    touches = random_touches(plug.space, 3, 11)
    _, sensors = world(touches, np.random.default_rng(1))
    far = [se3.transform(np.eye(3), [0, 0, z]) @ sensors[0] for z in (2.0, 3.0)]
    masks, T = [t.mask for t in touches], [*sensors, *far]
    masks += [np.zeros_like(masks[0])] * 2
    alone = plug.localize(masks[:3], "mask", None, T[:3], effort=GRID_ALONE)
    posterior = plug.localize([masks[i] for i in order], "mask", None, [T[i] for i in order], effort=GRID_ALONE)
    assert abs(np.exp(posterior.log_prob) - np.exp(alone.log_prob)).sum() < 1e-3
    assert posterior.entropy_nats == pytest.approx(alone.entropy_nats, abs=1e-3)
    for one, other in zip(alone.modes(3), posterior.modes(3), strict=True):
        np.testing.assert_allclose(one.T, other.T, atol=1e-6)


@pytest.mark.parametrize("apart", [0.05, 0.3])
def test_a_sensor_that_faces_away_does_not_constrain_poses_behind_it(plug, rng, apart):
    touch = random_touches(plug.space, 1, 7)[0]
    _, sensors = world([touch], rng)
    away = sensors[0] @ se3.transform(np.eye(3), [0, 0, -apart]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    empty = np.zeros_like(touch.mask)
    posterior = plug.localize([touch.mask, empty], "mask", None, np.stack([sensors[0], away]), effort=GRID_ALONE)
    alone = single(plug, touch, sensors[0])
    assert abs(cell_densities(posterior) - cell_densities(alone)).sum() < 1e-3 * cell_densities(alone).sum()


def test_no_contact_anywhere_leaves_the_poses_that_do_not_touch(plug, rng):
    touches = random_touches(plug.space, 2, 8)
    T, sensors = world(touches, rng)
    empty = np.zeros_like(touches[0].mask)
    posterior = plug.localize([empty, empty], "mask", None, sensors)
    assert not posterior.contact and posterior.modes() == []
    assert posterior.log_density(T) == -np.inf
    assert posterior.log_density(se3.transform(np.eye(3), [0, 0, 5.0]) @ T) == 0


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_sensors_without_contact_never_exclude_the_truth_for_a_later_one(plug, order):
    """Two of them stay half a millimetre before the object, in either order; a touch comes later."""
    empty = np.zeros(plug.sensor.image_size_px[::-1], bool)
    for seed in range(4):
        touches = random_touches(plug.space, 3, 50 + seed)
        T, sensors = world(touches, np.random.default_rng(seed))
        for i in (0, 1):
            sensors[i] = sensors[i] @ se3.transform(np.eye(3), [0, 0, -touches[i].penetration - 0.5e-3])
        before = plug.localize([empty, empty], "mask", None, sensors[order])
        assert not before.contact and np.isfinite(before.log_density(T))
        posterior = plug.localize(touches[2].mask, "mask", None, sensors[2], prior=before, effort=GRID_ALONE)
        alone = plug.localize(touches[2].mask, "mask", None, sensors[2], effort=GRID_ALONE)
        assert posterior.log_density(T) > alone.log_density(T) - 3


def test_sensors_that_exclude_each_other_are_named(plug, rng):
    touches = random_touches(plug.space, 3, 9)
    T, sensors = world(touches, rng)
    wrong = sensors.copy()
    wrong[2, :3, 3] += [0.0, 0.0, 0.5]
    with pytest.raises(InputError, match="agrees with sensor 3 and with all others"):
        plug.localize([t.mask for t in touches], "mask", None, wrong)
    with pytest.raises(
        InputError, match="no pose of connector_plug agrees with both sensors; .*perhaps the matrices are inverted"
    ):
        plug.localize([t.mask for t in touches[1:]], "mask", None, wrong[1:])


def test_an_improbable_sensor_is_a_warning(plug, rng):
    """Support far below chance is a warning; agreement is not."""
    touches = random_touches(plug.space, 3, 10)
    _, sensors = world(touches, rng)
    fused = fuse([single(plug, touch, T) for touch, T in zip(touches, sensors, strict=True)])
    assert disagreement(fused) is None
    against = replace(fused, support=np.array([1.0, -4.0, 2.0]))
    assert disagreement(against).startswith("sensor 2 of 3 disagrees")
    assert "check its T_world_sensor" in disagreement(against) and "the prior, its" in disagreement(
        against, with_prior=True
    )


def test_a_prior_counts_once(plug, rng):
    touches = random_touches(plug.space, 2, 11)
    T, sensors = world(touches, rng)
    images = [t.mask for t in touches]
    near = plug.localize(images, "mask", None, sensors, prior=(T[None], np.zeros(1)), effort=GRID_ALONE)
    assert (cell_densities(near) > 0).sum() == 1 and near.log_density(T) > 5

    def nearer(T):  # in the world, where the first sensor stands
        return -0.5 * (np.linalg.norm(T[:, :3, 3], axis=1) / 0.01) ** 2

    plain = plug.localize(images, "mask", None, sensors, effort=GRID_ALONE)
    graded = plug.localize(images, "mask", None, sensors, prior=nearer, effort=GRID_ALONE)
    before = nearer(sensors[0] @ plug.index.poses(graded.cells))
    likely = np.flatnonzero(graded.log_prob > graded.log_prob.max() - 12)
    some = graded.cells[likely]
    slope = np.polyfit(before[likely], cell_log_density(graded, some) - cell_log_density(plain, some), 1)[0]
    assert slope == pytest.approx(1, abs=0.1)


def test_the_posterior_of_one_sensor_is_a_prior_for_another(plug, rng):
    """One after the other, two sensors do not exclude the truth, and give more information than each alone."""
    gains = []
    for seed in range(50, 55):
        touches = random_touches(plug.space, 2, seed)
        T, sensors = world(touches, rng)
        before, alone = (single(plug, touch, at) for touch, at in zip(touches, sensors, strict=True))
        after = plug.localize(touches[1].mask, "mask", None, sensors[1], prior=before, effort=GRID_ALONE)
        assert np.exp(after.log_prob).sum() == pytest.approx(1, abs=1e-4)
        gains.append([posterior.log_density(T) for posterior in (before, alone, after)])
    assert np.isfinite(gains).all()
    first, second, both = np.mean(gains, 0)
    assert both > max(first, second) + 0.3


def test_an_image_that_counts_twice_is_a_warning(plug, rng):
    touches = random_touches(plug.space, 2, 12)
    _, sensors = world(touches, rng)
    images = [touch.mask for touch in touches]
    both = plug.localize(images, "mask", None, sensors, effort=GRID_ALONE)
    assert not any("same" in warning for warning in both.warnings)
    again = plug.localize([images[0], images[0]], "mask", None, sensors, effort=GRID_ALONE)
    assert any(warning.startswith("images 1 and 2 are the same") for warning in again.warnings)
    once = plug.localize(images[0], "mask", None, sensors[0], effort=GRID_ALONE)
    then = plug.localize(images[1], "mask", None, sensors[1], prior=once, effort=GRID_ALONE)
    for prior in (once, then):  # what the prior's own prior was made from counts too
        twice = plug.localize(images[0], "mask", None, sensors[0], prior=prior, effort=GRID_ALONE)
        assert any("counts twice" in warning for warning in twice.warnings)
    assert not any("counts twice" in warning for warning in then.warnings)


def test_a_repeated_touch_adds_hardly_any_evidence(plug):
    """Two sensors at one place show the same, so that together they are about as informative as one."""
    touch = random_touches(plug.space, 1, 13)[0]
    sensors = np.stack([np.eye(4), se3.transform(np.eye(3), [0, 0, 2e-6])])
    once = plug.localize(touch.mask, "mask", effort=GRID_ALONE).log_evidence
    twice = plug.localize([touch.mask] * 2, "mask", None, sensors, effort=GRID_ALONE).log_evidence
    assert abs(twice - once) < 0.3 * abs(once)  # what is left is the share of a cell that touches the second sensor


def test_a_posterior_saved_and_loaded_is_the_same(plug, rng, tmp_path, cache_dir):
    touches = random_touches(plug.space, 2, 12)
    T, sensors = world(touches, rng)
    posterior = plug.localize([t.mask for t in touches], "mask", None, sensors)
    posterior.save(tmp_path / "p.npz")
    again = type(posterior).load(tmp_path / "p.npz", cache_dir)
    assert again.log_density(T) == pytest.approx(posterior.log_density(T), abs=1e-3)
    np.testing.assert_allclose([m.T for m in again.modes(3)], [m.T for m in posterior.modes(3)], atol=1e-9)


def test_bad_sensor_poses_are_refused(plug):
    mask = np.zeros(plug.sensor.image_size_px[::-1], bool)
    T, millimetres = (np.stack([np.eye(4), se3.transform(np.eye(3), [x, 0, 0])]) for x in (0.1, 20.0))
    cases = [
        (UsageError, "2 images need T_world_sensor", {}),
        (UsageError, "expected one pose for each of 2 images", {"T_world_sensor": T[0]}),
        (InputError, "sensors 1 and 2 are at the same pose", {"T_world_sensor": np.stack([T[0], T[0]])}),
        (InputError, "20 m apart; give translations in metres", {"T_world_sensor": millimetres}),
    ]
    for error, words, options in cases:
        with pytest.raises(error, match=words):
            plug.localize([mask, mask], "mask", **options)
    with pytest.raises(UsageError, match="expected one background, or 2, got 3"):
        plug.localize([mask, mask], "mask", [None] * 3, T)
    with pytest.raises(UsageError, match="an empty list"):
        plug.localize([], "mask")


@pytest.mark.parametrize(
    ("scenes", "max_poses", "more"), [(3, 3_000, 0.0), pytest.param(8, 20_000, 0.5, marks=pytest.mark.slow)]
)
def test_sensors_may_differ(make_localizer, plug, rng, scenes, max_poses, more):
    """The second sensor has another window and other optics."""
    other = make_localizer("connector_plug", "gelsight-mini", max_poses=max_poses)
    both = type(plug)(plug.index, plug.scorer, plug.max_poses, plug.cache_dir, (other,))
    gains = []
    for i in range(scenes):
        touches = [random_touches(plug.space, 1, 20 + i)[0], random_touches(other.space, 1, 40 + i)[0]]
        T, sensors = world(touches, rng)
        together = both.localize([t.mask for t in touches], "mask", None, sensors, effort=GRID_ALONE)
        assert together.sensor.name == "gelslim"
        gains.append(together.log_density(T) - single(plug, touches[0], sensors[0]).log_density(T))
    assert np.mean(gains) > more
    with pytest.raises(UsageError, match="prepared for 2 sensors, got 1 images"):
        both.localize(touches[0].mask)
    with pytest.raises(UsageError, match="prepared for 2 sensors, got 3 images"):
        both.localize([touches[0].mask] * 3, "mask", None, np.stack([*sensors, se3.transform(np.eye(3), [1, 0, 0])]))


def test_the_command_takes_several_images(plug, rng, tmp_path, monkeypatch):
    touches = random_touches(plug.space, 2, 14)
    T, sensors = world(touches, rng)
    paths = []
    for i, touch in enumerate(touches):
        paths.append(str(tmp_path / f"{i}.png"))
        write_image(paths[-1], touch.mask, ({"object": "gear"}, {"sensor": "digit"})[i])
    poses = tmp_path / "poses.json"
    # with a byte order mark, as some editors write it
    poses.write_text(json.dumps({"T_world_sensor": sensors.tolist(), "std_mm": 0.5}), "utf-8-sig")
    monkeypatch.setattr(Localizer, "prepare", classmethod(lambda cls, *args, **options: plug))
    quick = ["--effort", "fast", "--report", "none"]
    args = ["localize", *paths, "--object", "connector_plug", "--sensor", "gelslim", *quick]
    done = CliRunner().invoke(app, [*args, "--sensor-poses", str(poses), "--json", "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert "0.png was made of gear by its metadata, but is localized with connector_plug" in done.stderr
    assert "1.png was made with digit by its metadata, but is localized with gelslim" in done.stderr
    content = json.loads((tmp_path / "out" / "result.json").read_text("utf-8"))
    assert content["frame"] == "world" and len(content["settings"]["views"]) == 2 and content["modes"]
    for text, words in [
        ("{}", "expected {"),
        (json.dumps({"T_world_sensor": sensors[:1].tolist()}), "for each of 2 images, got 1"),
        (json.dumps({"T_world_sensor": sensors[0].tolist()}), "got one 4x4; put it into a list"),
        (json.dumps({"T_world_sensor": sensors[:, :3].tolist()}), "got 2 of 3x4"),
        (json.dumps({"T_world_sensor": [sensors[0].tolist(), [1, 2]]}), "got 2, not all 4x4"),
        (json.dumps({"T_world_sensor": (2 * sensors).tolist()}), "no rotation"),
        (json.dumps({"T_world_sensor": sensors.tolist(), "std": 1}), "unknown key 'std'"),
        (json.dumps({"T_world_sensor": sensors.tolist(), "std_mm": -1}), "std_mm must be a finite number >= 0"),
        (json.dumps({"T_world_sensor": sensors.tolist(), "std_deg": np.inf}), "std_deg must be a finite number >= 0"),
    ]:
        poses.write_text(text)
        done = CliRunner().invoke(app, [*args, "--sensor-poses", str(poses)])
        assert done.exit_code == 3 and words in done.output and "\n" not in done.output.strip()
    done = CliRunner().invoke(app, args)
    assert done.exit_code == 2 and "2 images need --sensor-poses" in done.output


@pytest.mark.slow
def test_a_jaw_on_a_plain_rod_leaves_the_shift_along_it_open(make_localizer):
    """Both fingers see the same all along: no mode is certain where along the rod they hold it."""
    bar = trimesh.creation.cylinder(6e-3, 0.1, sections=64)
    rod = make_localizer(Mesh(bar.vertices, bar.faces, "rod", "m").with_symmetry(), "gelslim", max_poses=8_000)
    lying = se3.transform(se3.exp([0, np.pi / 2, 0, 0, 0, 0])[:3, :3], [0.0, 0.0, 5e-3])  # its axis along x, 1 mm deep
    opposite = se3.transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 10e-3])
    sensors = np.stack([np.eye(4), opposite])
    masks = [rod.simulate(se3.inverse(T) @ lying).mask for T in sensors]
    assert all(mask.any() for mask in masks)
    posterior = rod.localize(masks, "mask", None, sensors)
    mode = posterior.modes(1)[0]
    along = np.zeros(6)
    along[3:] = mode.T[:3, :3].T @ [1.0, 0.0, 0.0]  # a shift along the rod, as xi
    assert mode.T[0, :3] @ [0, 0, 1] == pytest.approx(np.sign(mode.T[0, 2]), abs=0.1)  # it lies along x
    assert np.abs(mode.observable @ along).max(initial=0) < 0.1
    assert np.sqrt(along @ mode.covariance @ along) > 1e-3 and mode.probability < 0.7
    across = np.zeros(6)
    across[3:] = mode.T[:3, :3].T @ [0.0, 1.0, 0.0]
    assert np.linalg.norm(mode.observable @ across) > 0.9


def test_the_pose_uncertainty_of_extrinsics_equals_their_propagated_errors(rng):
    T, sensors = se3.exp(rng.normal(size=6)), se3.exp(0.3 * rng.normal(size=(2, 6)))
    rig = ExtrinsicsStd(2e-3, 0.5e-3)
    eta = rng.normal(size=(40_000, 6)) * np.r_[[rig.rotation] * 3, [rig.translation] * 3]
    sampled = []
    for sensor in sensors:
        xi = se3.log(se3.inverse(T) @ sensor @ se3.exp(eta) @ se3.inverse(sensor) @ T)
        sampled.append(xi.T @ xi / len(xi))
    stated = extrinsics_covariance(T, sensors, rig)
    whiten = np.linalg.inv(np.linalg.cholesky(stated))
    assert whiten @ np.mean(sampled, 0) @ whiten.T == pytest.approx(np.eye(6), abs=0.05)


@pytest.mark.slow
def test_wrong_extrinsics_are_a_warning_and_right_ones_hardly_ever(plug):
    """Each sensor but the first is off by 5 mm in a random direction: a warning, unless the stated uncertainty covers it.

    Were one right set of extrinsics in ten warned of, five of twelve would be once in 230 times.
    """
    rng = np.random.default_rng(5)
    warned = {"right": 0, "off": 0, "known to be": 0}
    for scene in simultaneous_touches(plug.space, 12, 3, 9):
        masks = [touch.mask for touch in scene.touches]
        off = scene.T_world_sensor.copy()
        way = rng.normal(size=(2, 3))
        off[1:, :3, 3] += 5e-3 * way / np.linalg.norm(way, axis=1, keepdims=True)
        rigs = {
            "right": (scene.T_world_sensor, None),
            "off": (off, None),
            "known to be": (off, ExtrinsicsStd(0.0, 5e-3)),
        }
        for name, (T, rig) in rigs.items():
            try:
                options = {"T_world_sensor": T, "extrinsics_std": rig, "effort": "fast"}
                posterior = plug.localize(masks, "mask", **options)
            except NoPoseAgreesError:
                continue
            warned[name] += any("agree badly" in warning for warning in posterior.warnings)
    assert warned["right"] <= 4 and warned["off"] >= warned["right"] + 6 and warned["known to be"] == 0, warned
    assert poor_agreement(np.inf, 2.0) and not poor_agreement(None, 2.0) and not poor_agreement(1.9, 2.0)
