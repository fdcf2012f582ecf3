"""Laws of localization: priors multiply, frames and files make no difference, and probabilities come true."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from scipy.stats import binom
from speed import slow_but

from geomtact import InputError, Localizer, PoseError, Sensor, UsageError
from geomtact.contact_space.store import open_index
from geomtact.contact_space.touches import random_touches
from geomtact.geometry.approach import approach_of
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.mesh_file import load_mesh
from geomtact.inference.densities import GaussianPrior
from geomtact.inference.effort import GRID_ALONE, Effort
from geomtact.inference.posterior import Posterior
from geomtact.inference.prior import prior_log_mass
from geomtact.registration.contact_problem import SINK
from geomtact.scoring import fitted
from geomtact.se3 import exp, log, random_rotations, transform

MM = 1e-3
T_WORLD = exp([0.3, -1.2, 0.5, 0.4, -0.1, 0.7])


def pressed(localizer, T):
    return localizer.simulate(T).mask


# --- what comes out


def test_a_press_at_the_true_pose_is_more_probable_than_chance(localizer, a_touch):
    T, mask = a_touch(localizer)
    posterior = localizer.localize(mask)
    assert posterior.entropy_nats < -0.3
    if localizer.index.resolution.step < 5 * MM:  # on coarser grids a single touch may be misjudged
        assert posterior.log_density(T) > 1
        assert posterior.credible_level(T) < 0.95


def test_the_nut_on_its_flat_is_localized_by_its_hole(flat_nut, uniform_poses):
    """With the contact face given, one mask constrains x, y and depth of a nut pressed over the window."""
    T, _ = uniform_poses(flat_nut)
    area = np.array([pressed(flat_nut, pose).sum() for pose in T[:80]])
    error = []
    for pose in T[:80][np.argsort(-area)[:6]]:
        mode = flat_nut.localize(pressed(flat_nut, pose)).modes(1)[0]
        error.append(np.linalg.norm((mode.T - pose)[:2, 3]))
    assert np.median(error) < 0.5 * MM


@pytest.mark.parametrize("name", slow_but(("curved", "flat_nut", "ball"), "flat_nut", "ball"))
def test_the_first_modes_predict_the_contact_that_is_seen(name, request, uniform_poses):
    """At a mode, the contact is where the object lies deeper than a gel of either kind is taken to sink around it; about so,
    because a deeper pose on a softer gel shows the same contact: 0.65 of the area on a ball."""
    localizer = request.getfixturevalue(name)
    T, _ = uniform_poses(localizer)
    iou = []
    for pose in T[:7]:
        seen = pressed(localizer, pose)
        modes = np.array([mode.T for mode in localizer.localize(seen).modes(5)])
        predicted = localizer.space.caster.depths(localizer.sensor, modes, seen.shape) > SINK
        iou.append([(seen & p).sum() / (seen | p).sum() for p in predicted])
    first, best = np.median([i[0] for i in iou]), np.median([max(i) for i in iou])
    assert first > 0.6 and best > 0.8


def test_assumptions_made_in_loading_the_mesh_come_with_every_posterior(ball, a_touch):
    mesh = replace(ball.mesh, warnings=("ball.stl: 37 bytes after the last triangle are passed over",))
    doubtful = replace(ball, index=replace(ball.index, mesh=mesh))
    for mask in (a_touch(ball)[1], np.zeros(ball.sensor.image_size_px[::-1], bool)):
        assert doubtful.localize(mask).warnings[:1] == list(mesh.warnings)


def test_the_same_seed_gives_the_same_result(localizer, a_touch):
    T, mask = a_touch(localizer)
    one, other = (localizer.localize(mask, seed=3) for _ in range(2))
    assert (one.log_prob == other.log_prob).all() and (one.cells == other.cells).all()
    assert one.credible_level(T) == other.credible_level(T)
    for a, b in zip(one.modes(), other.modes(), strict=True):
        assert np.abs(a.T - b.T).max() < 1e-12  # sums of products may be taken in another order
        assert a.probability == pytest.approx(b.probability, abs=1e-12)
    third = localizer.localize(mask, seed=4)
    assert (third.cell_log_prob == one.cell_log_prob).all() and third.credible_level(T) != one.credible_level(T)


def test_efforts_differ_in_resolution_and_in_refinement(curved, a_touch):
    T, mask = a_touch(curved)
    alone, fast, balanced, exact = (curved.localize(mask, effort=e) for e in (GRID_ALONE, "fast", "balanced", "exact"))
    assert alone.explored is None
    for each in (fast, balanced, exact):
        assert len(each.cells) == len(alone.cells)
        assert each.explored is not None and each.information_gain_nats > alone.information_gain_nats + 1
    assert fast.explored.contacts <= balanced.explored.contacts < exact.explored.contacts
    assert len(fast.refined) == 0 < len(balanced.refined) <= 5 <= len(exact.refined) <= 25
    refined = np.stack([found.T for found in balanced.refined.values()])
    before, after = (
        balanced.explored.density.log_density(T) for T in (balanced.explored.hearts[: len(refined)], refined)
    )
    assert (after >= before - 1e-6).all(), "a refined pose is no less dense"
    with pytest.raises(UsageError, match="no effort named 'quick'"):
        curved.localize(mask, effort="quick")


def test_settings_and_times_are_recorded(plug, a_touch):
    posterior = plug.localize(a_touch(plug)[1], seed=9)
    assert posterior.settings["seed"] == posterior.seed == 9
    assert posterior.settings["poses"] == len(plug.index) and posterior.settings["kind"] == "mask"
    assert set(posterior.timing_ms) == {"read", "score", "posterior", "explore", "refine"}
    assert posterior.observation.contact.mask.any() and posterior.warnings == []


def test_an_outlier_contact_is_a_warning(ball):
    """A ball never makes a frame along the border of the window."""
    mask = np.zeros(ball.sensor.image_size_px[::-1], bool)
    mask[:12], mask[-12:], mask[:, :12], mask[:, -12:] = True, True, True, True
    assert any("out-of-distribution contact" in w for w in ball.localize(mask).warnings)


@pytest.mark.slow
def test_a_hollow_that_the_sensor_fits_into_is_warned_of(cache_dir, monkeypatch):
    monkeypatch.setattr(fitted, "TOUCHES", 60)
    made = trimesh.creation.annulus(0.045, 0.055, 0.04, sections=32)
    tube = Localizer.prepare(
        Mesh(made.vertices, made.faces, "tube", "m"), max_poses=2000, scorer="moments", cache_dir=cache_dir
    )
    touch = tube.space.sample(1, np.random.default_rng(1))[0][0]
    assert any("hollows wider" in w for w in tube.localize(tube.simulate(touch).mask).warnings)


def test_simulate_is_the_exact_cast(plug, a_touch):
    T, mask = a_touch(plug)
    contact = plug.simulate(T.tolist())
    assert (contact.mask == mask).all() and contact.mask.shape == plug.sensor.image_size_px[::-1]
    assert contact.height.max() == pytest.approx(plug.space.penetration(T)[0], abs=0.05 * MM)
    with pytest.raises(PoseError):
        plug.simulate(np.eye(3))
    with pytest.raises(PoseError, match="expected one pose"):
        plug.simulate(np.stack([T, T]))


# --- evidence


def test_the_evidence_prefers_the_object_that_was_pressed(make_localizer, ball, flat_nut, curved_sensor, uniform_poses):
    T, _ = uniform_poses(flat_nut)
    area = [pressed(flat_nut, pose).sum() for pose in T[:80]]
    nut_mask = pressed(flat_nut, T[int(np.argmax(area))])
    ball_mask = pressed(ball, transform(np.eye(3), [1 * MM, 1 * MM, 5 * MM]))
    assert flat_nut.localize(nut_mask).log_evidence > ball.localize(nut_mask).log_evidence + 3
    assert ball.localize(ball_mask).log_evidence > flat_nut.localize(ball_mask).log_evidence + 3


# --- priors


def test_a_constant_prior_is_none(localizer, a_touch):
    mask = a_touch(localizer)[1]
    none = localizer.localize(mask, effort=GRID_ALONE)
    for c in (0.0, 7.0):
        constant = localizer.localize(mask, effort=GRID_ALONE, prior=lambda T, c=c: np.full(len(T), c))
        assert (constant.cells == none.cells).all()
        assert constant.log_prob == pytest.approx(none.log_prob, abs=1e-4)
        assert constant.log_evidence == pytest.approx(none.log_evidence, abs=1e-4)


def test_contacts_gain_as_much_under_a_constant_prior(localizer, a_touch):
    """The coarse density differs in its last bits, and with it the poses that are drawn: so within their chance."""
    T, mask = a_touch(localizer)
    gains = [
        localizer.localize(mask, prior=prior, seed=seed).log_density(T)
        for prior in (None, lambda T: np.full(len(T), 7.0))
        for seed in range(3)
    ]
    assert np.mean(gains[:3]) == pytest.approx(np.mean(gains[3:]), abs=1.5) and min(gains) > 1


def test_a_prior_multiplies_the_likelihood(plug, a_touch, rng):
    """For any log density f, the posterior is the likelihood times f, and a share of f itself."""
    mask = a_touch(plug)[1]
    f = 4 * rng.normal(size=len(plug.index))
    f[rng.random(len(f)) < 0.2] = -np.inf
    chunks = iter(np.split(f, range(1 << 16, len(f), 1 << 16)))
    posterior = plug.localize(mask, effort=GRID_ALONE, prior=lambda T: next(chunks))
    log_likelihood = plug.scorer.scorer.score(plug.index, mask) / plug.scorer.calibration.temperature
    prior = np.exp(plug.index.log_weight.astype(float) + f)
    prior /= prior.sum()
    joint = np.exp(log_likelihood.ravel().astype(float) - log_likelihood.max()) * prior
    floor = plug.scorer.calibration.floor
    expected = (1 - floor) * joint / joint.sum() + floor * prior
    got = np.zeros(len(plug.index))
    got[posterior.cells] = np.exp(posterior.log_prob)
    assert np.abs(got - expected).max() < 1e-4 * expected.max()
    assert (got[prior == 0] == 0).all() and (got[prior > 0] > 0).all()


def test_a_posterior_as_prior_is_used_as_it_is(localizer, a_touch):
    """The same image again: the likelihood counts twice."""
    mask = a_touch(localizer)[1]
    once = localizer.localize(mask, effort=Effort(5))
    twice = localizer.localize(mask, effort=Effort(0), prior=once)
    log_likelihood = localizer.scorer.scorer.score(localizer.index, mask) / localizer.scorer.calibration.temperature
    p = np.exp(once.log_prob)
    joint = p * np.exp((log_likelihood - log_likelihood.max()).ravel().astype(float)[once.cells])
    floor = localizer.scorer.calibration.floor
    expected = (1 - floor) * joint / joint.sum() + floor * p
    assert (twice.cells == once.cells).all()
    assert np.exp(twice.log_prob) == pytest.approx(expected / expected.sum(), rel=1e-3, abs=1e-12)
    assert twice.entropy_nats < once.entropy_nats


def test_a_saved_posterior_is_as_good_a_prior(ball, a_touch, tmp_path, monkeypatch, cache_dir):
    monkeypatch.setenv("GEOMTACT_CACHE", str(cache_dir))
    mask = a_touch(ball)[1]
    once = ball.localize(mask, effort=GRID_ALONE)
    once.save(tmp_path / "once.npz")
    from_memory, from_disk = (
        ball.localize(mask, effort=GRID_ALONE, prior=p) for p in (once, str(tmp_path / "once.npz"))
    )
    assert from_disk.log_prob == pytest.approx(from_memory.log_prob, abs=1e-3)


def test_weighted_poses_as_prior_gather_the_mass(localizer, a_touch, uniform_poses):
    T_true, mask = a_touch(localizer)
    others = uniform_poses(localizer)[0][:9]
    poses = np.concatenate([T_true[None], others])
    log_weights_ = np.log(np.r_[0.5, np.full(9, 0.5 / 9)])
    posterior = localizer.localize(mask, prior=(poses, log_weights_), effort=GRID_ALONE)
    assert len(posterior.cells) <= 10
    assert posterior.log_density(T_true) > localizer.localize(mask, effort=GRID_ALONE).log_density(T_true)
    radius = mode_radius(localizer.mesh)
    distance = PoseDistance(localizer.mesh, 128)
    own = localizer.index.poses(posterior.cells)
    assert len(own) == len(posterior.poses)
    # the weights are masses: doubling all of them changes nothing
    again = localizer.localize(mask, prior=(poses, log_weights_ + 1), effort=GRID_ALONE)
    assert again.log_prob == pytest.approx(posterior.log_prob, abs=1e-5)
    best = posterior.modes(1)[0]
    assert distance.mean(best.T, own).min() <= radius


def test_a_gaussian_prior_lies_about_its_mean(localizer, uniform_poses):
    index, T = localizer.index, uniform_poses(localizer)[0][0]
    T_world_sensor = exp([0.3, -0.2, 0.5, 0.1, 0.2, 0.3])
    narrow = GaussianPrior(T_world_sensor @ T, 1e-8 * np.eye(6))
    mass = np.exp(prior_log_mass(index, narrow, T_world_sensor, "world"))
    off = PoseDistance(localizer.mesh, 128).mean(T, index.poses(np.arange(len(index))))
    within = np.sqrt(np.sum((index.angle_step * localizer.mesh.radius_rms) ** 2 + 2 * index.resolution.step**2))
    assert mass @ (off < 1.5 * within) > 0.9
    if localizer.index.approach is not None or localizer.mesh.symmetry.kind != "discrete":
        return
    turned = T_world_sensor @ T @ localizer.mesh.symmetry.elements[-1]
    again = np.exp(prior_log_mass(index, GaussianPrior(turned, narrow.covariance), T_world_sensor, "world"))
    assert again == pytest.approx(mass, abs=0.06)  # four deviations of a share of a thousand draws


@pytest.mark.slow
@pytest.mark.parametrize("std", [0.02, 0.1, 0.5])
def test_a_gaussian_prior_has_the_cells_of_its_samples(plug, uniform_poses, std):
    """Of what touches, by the exact caster; from narrower than a cell, where heights within it differ by more, to far wider.
    The total variation is bounded, draws included."""
    apart = {0.02: 0.1, 0.1: 0.2, 0.5: 1.0}[std]
    index, T = plug.index, uniform_poses(plug)[0][:2]
    spread = np.r_[[std] * 3, [std * 20 * MM] * 3]
    for true in T:
        drawn = true @ exp(np.random.default_rng(5).normal(size=(12_000, 6)) * spread)
        depth = plug.space.penetration(drawn)
        cells = index.lookup(drawn[np.isfinite(depth)], depth[np.isfinite(depth)])
        own = np.bincount(cells, minlength=len(index)) / len(cells)
        mass = np.exp(prior_log_mass(index, GaussianPrior(true, np.diag(spread**2)), np.eye(4), "sensor"))
        assert mass.sum() == pytest.approx(1, abs=1e-4)
        among = np.argsort(-own, kind="stable")[: np.searchsorted(np.cumsum(np.sort(own)[::-1]), 0.8) + 1]
        assert mass[among].sum() > 0.4
        assert 0.5 * np.abs(mass - own).sum() < apart


@pytest.mark.slow
@pytest.mark.parametrize("name", ["curved", "flat_nut"])
def test_a_prior_outlives_a_sensor_without_contact_whichever_image_it_names(name, request, uniform_poses):
    """A sensor far away has no contact: its posterior is the prior, the same for every image of a pose.

    As a prior for another sensor it has the density of the prior itself."""
    localizer = request.getfixturevalue(name)
    T, symmetry = T_WORLD @ uniform_poses(localizer)[0][0], localizer.mesh.symmetry
    far = T_WORLD.copy()
    far[:3, 3] += 3.0
    covariance = np.diag([0.1**2] * 3 + [(2 * MM) ** 2] * 3)
    nothing = np.zeros(localizer.sensor.image_size_px[::-1], bool)
    images = symmetry.elements[localizer.space.approaches(np.linalg.inv(T_WORLD) @ T @ symmetry.elements)]
    for S in images[[1, -1]]:
        prior = GaussianPrior(T @ S, covariance)
        posterior = localizer.localize(nothing, prior=prior, T_world_sensor=far)
        assert not posterior.contact
        assert np.ptp(posterior.log_density(T @ symmetry.elements)) < 1e-6
        here = prior_log_mass(localizer.index, posterior, T_WORLD, "world")
        assert here == pytest.approx(prior_log_mass(localizer.index, prior, T_WORLD, "world"), abs=1e-4)


@pytest.mark.parametrize("ranks", slow_but(((0, 59), (0, 30, 59)), (0, 59)))
def test_an_impossible_prior_is_refused_and_a_contradicted_one_is_mostly_a_warning(plug, uniform_poses, ranks):
    """About the true pose no warning; about those of far larger or smaller contacts, one in a third of the cases at least."""
    T = uniform_poses(plug)[0][:60]
    masks = [plug.simulate(pose).mask for pose in T]
    some = np.argsort([mask.sum() for mask in masks])[list(ranks)]
    covariance = np.diag([0.02**2] * 3 + [(0.5 * MM) ** 2] * 3)
    warned = np.zeros((len(ranks), len(ranks)), bool)
    for i, j in np.ndindex(warned.shape):
        prior = GaussianPrior(T[some[i]], covariance)
        warnings = plug.localize(masks[some[j]], "mask", prior=prior, effort=GRID_ALONE).warnings
        warned[i, j] = any("contradict each other" in warning for warning in warnings)
    assert not warned.diagonal().any() and warned.sum() >= len(ranks) * (len(ranks) - 1) / 3
    # at a metre, and that many standard deviations of 10 mm away from the sensor, beside which a cell is narrow
    wide = np.diag([0.02**2] * 3 + [(10 * MM) ** 2] * 3)
    near, far = (GaussianPrior(transform(T[0, :3, :3], T[0, :3, 3] + [0, 0, k * 10 * MM]), wide) for k in (6, 12))
    for away in (GaussianPrior(transform(T[0, :3, :3], [0, 0, 1]), covariance), far):
        with pytest.raises(
            InputError, match="no pose that touches the sensor lies within about 8 of its standard deviations"
        ):
            plug.localize(masks[0], "mask", prior=away)
    assert plug.localize(masks[0], "mask", prior=near, effort=GRID_ALONE).contact


@pytest.mark.parametrize("width", [0.3, 0.8, 2.0, 6.0])
def test_a_gaussian_prior_is_the_density_of_its_samples(rng, width):
    """Samples are turned as far, in the mean, as the density over evenly drawn poses gives; and the wider, the more."""
    prior = GaussianPrior(np.eye(4), np.diag([width**2] * 3 + [1.0] * 3))
    even = transform(random_rotations(300_000, rng), rng.uniform(-3.5, 3.5, (300_000, 3)))
    weight = np.exp(prior(even))
    turned = np.linalg.norm(log(even)[:, :3], axis=1)
    drawn = np.concatenate([prior.draw(10_000, rng) for _ in range(2 if width < 5 else 40)])
    expected = np.linalg.norm(log(drawn)[:, :3], axis=1).mean()
    assert weight @ turned / weight.sum() == pytest.approx(expected, rel=0.04)
    assert width < 6 or expected > 1.9


@pytest.mark.parametrize("covariance", [np.eye(3), np.zeros((6, 6)), np.arange(36).reshape(6, 6)])
def test_a_matrix_that_is_no_covariance_is_refused(covariance):
    with pytest.raises(InputError, match="positive definite covariance"):
        GaussianPrior(np.eye(4), covariance)


def test_poses_that_do_not_touch_carry_no_prior(ball, a_touch):
    T, mask = a_touch(ball)
    away = T + np.array([[0] * 4, [0] * 4, [0, 0, 0, 1.0], [0] * 4])
    posterior = ball.localize(mask, prior=(np.stack([T, away]), [0.0, 50.0]), effort=GRID_ALONE)
    assert len(posterior.cells) == 1 and np.isfinite(posterior.log_density(T))
    with pytest.raises(InputError, match="none of its poses touches the sensor"):
        ball.localize(mask, prior=(away[None], [0.0]))


def test_a_prior_in_the_world_frame_is_the_same_prior(plug, a_touch):
    T_true, mask = a_touch(plug)
    here = plug.localize(mask, prior=lambda T: -1e4 * ((T - T_true)[:, :3, 3] ** 2).sum(1), effort=GRID_ALONE)
    there = plug.localize(
        mask,
        T_world_sensor=T_WORLD,
        prior=lambda T: -1e4 * ((np.linalg.inv(T_WORLD) @ T - T_true)[:, :3, 3] ** 2).sum(1),
        effort=GRID_ALONE,
    )
    assert there.log_prob == pytest.approx(here.log_prob, abs=1e-3)
    pair = (np.stack([T_WORLD @ T_true]), [0.0])
    only = plug.localize(mask, T_world_sensor=T_WORLD, prior=pair, effort=GRID_ALONE)
    assert np.isfinite(only.log_density(T_WORLD @ T_true)) and len(only.cells) == 1


def test_a_posterior_of_another_touch_in_the_world_is_a_prior(ball):
    """Two sensors' poses, one ball: the first touch is a prior for the second on where the ball is."""
    ball_in_world = transform(np.eye(3), [0.2, 0.1, 0.3])
    first = ball_in_world @ np.linalg.inv(transform(np.eye(3), [2 * MM, 1 * MM, 5 * MM]))
    second = ball_in_world @ np.linalg.inv(transform(np.eye(3), [-3 * MM, 2 * MM, 5.3 * MM]))
    mask_1, mask_2 = (pressed(ball, np.linalg.inv(T) @ ball_in_world) for T in (first, second))
    prior = ball.localize(mask_1, T_world_sensor=first, effort=GRID_ALONE)
    alone = ball.localize(mask_2, T_world_sensor=second, effort=GRID_ALONE)
    both = ball.localize(mask_2, T_world_sensor=second, prior=prior, effort=GRID_ALONE)
    assert both.frame == "world"
    assert both.log_density(ball_in_world) > alone.log_density(ball_in_world)
    assert both.entropy_nats < alone.entropy_nats - 0.2


@pytest.mark.parametrize(
    ("prior", "error", "message"),
    [
        (3, UsageError, "expected a Posterior, the path of a saved one, a pair"),
        ((np.eye(4)[None], [0.0, 0.0]), InputError, r"expected one log weight a pose, \(1,\)"),
        ((np.eye(4)[None], [np.nan]), InputError, "expected one log weight a pose"),
        ((np.eye(3)[None], [0.0]), PoseError, "expected rigid transforms"),
        ((np.eye(4)[None], [np.inf]), InputError, "expected one log weight a pose"),
        (lambda T: np.full(len(T), np.nan), InputError, "NaN or infinite at some poses"),
        (lambda T: 0.0, InputError, r"returned shape \(\); return one log density a pose"),
        (lambda T: np.full(len(T), -np.inf), InputError, "rules out every pose"),
    ],
    ids=["number", "two weights", "NaN weight", "3x3", "infinite weight", "NaN density", "no array", "nothing"],
)
def test_a_prior_that_makes_no_sense_is_refused(ball, a_touch, prior, error, message):
    with pytest.raises(error, match=message) as caught:
        ball.localize(a_touch(ball)[1], prior=prior)
    assert "\n" not in str(caught.value)


def test_a_mode_is_a_prior(localizer, a_touch):
    """Of a ball as well, whose turns are unobservable."""
    mode = localizer.localize(a_touch(localizer)[1]).modes(1)[0]
    prior = GaussianPrior(mode.T, mode.covariance)
    assert localizer.localize(a_touch(localizer)[1], prior=prior, effort=GRID_ALONE).log_density(mode.T) > 0


def test_a_prior_of_another_object_or_frame_is_refused(ball, flat_nut, a_touch):
    mask = a_touch(ball)[1]
    other = flat_nut.localize(a_touch(flat_nut)[1], effort=GRID_ALONE)
    with pytest.raises(InputError, match="it is for the object 'hex_nut', not for 'ball'"):
        ball.localize(mask, prior=other)
    world = ball.localize(mask, T_world_sensor=T_WORLD, effort=GRID_ALONE)
    with pytest.raises(InputError, match="its frame is 'world' but this posterior's is 'sensor'"):
        ball.localize(mask, prior=world)
    held = ball.localize(mask, effort=GRID_ALONE)
    elsewhere = replace(
        held, index=replace(held.index, sensor=replace(ball.sensor, camera_distance=0.03, name="other"))
    )
    with pytest.raises(InputError, match="in the frame of the sensor 'other', not of 'gelsight-mini'"):
        ball.localize(mask, prior=elsewhere)
    nothing = ball.localize(np.zeros_like(mask))
    with pytest.raises(InputError, match="does not touch the sensor"):
        ball.localize(mask, prior=nothing)
    lost = ball.localize(np.zeros_like(mask), prior=held)
    assert (
        not lost.contact
        and lost.off_contact_log_density is None
        and any("contact was lost" in each for each in lost.warnings)
    )
    assert lost.provenance.images == ()  # what is given up does not count twice later
    with pytest.raises(InputError, match="in the frame of the sensor 'other', not of 'gelsight-mini'"):
        ball.localize(np.zeros_like(mask), prior=elsewhere)


# --- approach


def test_off_the_approach_the_density_is_minus_infinity(cone, flat_nut, uniform_poses, a_touch):
    for localizer in (cone, flat_nut):
        posterior = localizer.localize(a_touch(localizer)[1], effort=GRID_ALONE)
        T, depth = uniform_poses(localizer)
        T, depth = T[:40], depth[:40]
        tilted = T @ exp([0.9, 0.4, 0, 0, 0, 0])
        free = localizer.space.__class__(localizer.mesh, localizer.sensor)
        tilted, ok = free.settle(tilted, depth)
        ok[ok] = np.isfinite(free.penetration(tilted[ok]))
        off = ok & ~localizer.space.approaches(tilted)
        assert off.sum() >= 3
        assert (posterior.log_density(tilted[off]) == -np.inf).all()
        assert np.isfinite(posterior.log_density(T)).all()
    on_face = approach_of(T[:, :3, :3]) @ [0, 0, 1]
    assert np.abs(on_face - 1).max() < 1e-12


def test_an_exact_face_holds_to_a_millionth_of_a_radian(flat_nut, uniform_poses, a_touch):
    posterior = flat_nut.localize(a_touch(flat_nut)[1], effort=GRID_ALONE)
    T, depth = uniform_poses(flat_nut)
    middle = (depth > 0.2 * MM) & (depth < 1.8 * MM)
    for tilt, inside in ((5e-7, True), (5e-6, False)):
        finite = np.isfinite(posterior.log_density(T[middle][:20] @ exp([tilt, 0, 0, 0, 0, 0])))
        assert (finite == inside).all()


# --- the same object


def test_millimetre_stl_and_metre_glb_give_one_posterior(make_localizer, tmp_path):
    """Neither the file's format nor its unit matters, as far as its numbers are the same."""
    solid = trimesh.creation.box((12, 8, 6)).subdivide()
    solid.vertices = np.round(solid.vertices * 64) / 64  # exact in single precision, in millimetres
    solid.export(tmp_path / "part.stl")
    metres = solid.copy()
    metres.vertices = metres.vertices / 1000
    metres.export(tmp_path / "part.glb")
    sensor = Sensor("small", (64, 48), (0.3 * MM, 0.3 * MM), 0.0, 2 * MM)
    options = {"max_poses": 4000, "touches": 60}
    a = make_localizer(tmp_path / "part.stl", sensor, unit="mm", **options)
    b = make_localizer(tmp_path / "part.glb", sensor, **options)
    assert a.mesh.symmetry.kind == b.mesh.symmetry.kind == "discrete"
    T = transform(exp([0.4, 0.3, 0.2, 0, 0, 0])[:3, :3], [1 * MM, 2 * MM, 5 * MM])
    T = a.space.settle(T, 0.8 * MM)[0][0]
    mask = a.simulate(T).mask
    assert mask.any() and (b.simulate(T).mask == mask).mean() > 0.999
    pa, pb = a.localize(mask), b.localize(mask)
    assert pb.log_density(T) == pytest.approx(pa.log_density(T), abs=0.02)
    assert pb.entropy_nats == pytest.approx(pa.entropy_nats, abs=0.02)
    first, other = pa.modes(1)[0], pb.modes(1)[0]
    assert other.probability == pytest.approx(first.probability, abs=0.01)
    assert PoseDistance(a.mesh).mean(first.T, other.T[None])[0] < 0.05 * MM


@pytest.mark.slow
def test_the_order_of_vertices_and_faces_does_not_matter(make_localizer, rng):
    mesh = load_mesh("hex_nut")
    order = rng.permutation(len(mesh.vertices))
    where = np.argsort(order)
    shuffled = replace(mesh, vertices=mesh.vertices[order], faces=where[mesh.faces][rng.permutation(len(mesh.faces))])
    sensor = Sensor("small", (64, 48), (0.3 * MM, 0.3 * MM), 0.0, 2 * MM)
    a, b = (make_localizer(m, sensor, max_poses=4000, touches=60) for m in (mesh, shuffled))
    assert a.index.key != b.index.key
    T = a.space.sample(3, np.random.default_rng(0), (0.5 * MM, 1 * MM))[0]
    for pose in T:
        pa, pb = (localizer.localize(a.simulate(pose).mask, effort=GRID_ALONE) for localizer in (a, b))
        assert pb.log_density(pose) == pytest.approx(pa.log_density(pose), abs=0.05)


# --- is it true?


@pytest.mark.parametrize("n", slow_but((60, 100), 60))
def test_probabilities_come_true(plug, n):
    """Over fresh touches the truth gains information, and the credible regions hold it at their nominal rate."""
    touches = random_touches(plug.space, n, seed=77)
    gain, level = [], []
    for touch in touches:
        posterior = plug.localize(touch.mask, effort=GRID_ALONE)
        gain.append(posterior.log_density(touch.T_sensor_object))
        level.append(posterior.credible_level(touch.T_sensor_object))
    assert np.isfinite(gain).all() and np.mean(gain) > 0
    for nominal in (0.5, 0.9):
        low, high = binom.ppf([0.0005, 0.9995], n, nominal) / n
        share = np.mean(np.array(level) <= nominal)
        assert low - 0.1 <= share <= high + 0.1, (nominal, share)


def test_every_image_has_its_own_pose(plug, a_touch):
    mask = a_touch(plug)[1]
    with pytest.raises(UsageError, match="2 images need T_world_sensor"):
        plug.localize([mask, mask])
    with pytest.raises(UsageError, match="expected one pose for each of 1 images"):
        plug.localize(mask, T_world_sensor=np.stack([T_WORLD, T_WORLD]))
    with pytest.raises(PoseError, match="T_world_sensor"):
        plug.localize(mask, T_world_sensor=np.full((4, 4), np.nan))


def test_prepare_loads_its_own_files(ball, cache_dir, monkeypatch):
    monkeypatch.setattr("geomtact.scoring.fitted.simulate_touches", lambda *_, **__: pytest.fail("fitted again"))
    monkeypatch.setattr("geomtact.contact_space.store.build", lambda *_, **__: pytest.fail("built again"))
    again = Localizer.prepare("ball", sensor="gelsight-mini", max_poses=20_000, cache_dir=cache_dir)
    assert again.index.key == ball.index.key and again.scorer.calibration == ball.scorer.calibration
    assert isinstance(again.localize(np.zeros((240, 320), bool)), Posterior)


@pytest.mark.parametrize("name", slow_but(["curved", "flat_nut"], "flat_nut"))
def test_a_prior_about_any_symmetric_image_is_the_same_prior(name, request, a_touch):
    """Twelve turns of a nut are one pose: a camera that reports any of them gives the same prior."""
    localizer = request.getfixturevalue(name)
    T_true, mask = a_touch(localizer)
    seen = []
    for S in localizer.mesh.symmetry.elements:
        about = T_true @ S
        if not localizer.space.approaches(about[None])[0]:
            continue

        def near(T, about=about):
            angle = Rotation.from_matrix(np.swapaxes(T[:, :3, :3], 1, 2) @ about[:3, :3]).magnitude()
            return -0.5 * (angle / 0.4) ** 2 - 0.5 * (((T - about)[:, :3, 3] / (4 * MM)) ** 2).sum(1)

        posterior = localizer.localize(mask, prior=near, effort=GRID_ALONE)
        seen.append((posterior.log_density(T_true), posterior.log_evidence, posterior.entropy_nats))
    assert len(seen) >= 6
    assert np.ptp(np.array(seen), axis=0).max() < 1e-3


def test_a_constant_in_the_prior_means_nothing_and_a_small_density_is_not_none(plug, a_touch, uniform_poses):
    T_true, mask = a_touch(plug)

    def sharp(T):
        return -0.5 * (((T - T_true)[:, :3, 3] / (0.3 * MM)) ** 2).sum(1)

    posteriors = [plug.localize(mask, prior=lambda T, c=c: sharp(T) + c, effort=GRID_ALONE) for c in (0.0, 1e8)]
    assert posteriors[1].log_prob == pytest.approx(posteriors[0].log_prob, rel=1e-5, abs=1e-3)
    T = uniform_poses(plug)[0]
    assert sharp(plug.index.poses()).min() < -1000
    assert np.isfinite(posteriors[0].log_density(T)).all()
    assert np.exp(posteriors[0].log_prob).sum() == pytest.approx(1, abs=1e-5)


def test_no_contact_restricts_the_prior_to_poses_that_do_not_touch(plug, uniform_poses):
    T = uniform_poses(plug)[0][:20]
    nothing = np.zeros(plug.sensor.image_size_px[::-1], bool)
    away, deep = T.copy(), T.copy()
    away[:, 2, 3] += 0.3
    deep[:, 2, 3] -= 3 * MM  # deeper than the sensor allows, but touching all the same

    def prior(T):
        return -T[:, 2, 3]

    for posterior, expected in (
        (plug.localize(nothing), np.zeros(20)),
        (plug.localize(nothing, prior=prior), prior(away)),
        (plug.localize(nothing, prior=(away[:1], [-1.0])), np.r_[-1.0, np.full(19, -np.inf)]),
    ):
        assert (posterior.log_density(T) == -np.inf).all() and (posterior.log_density(deep) == -np.inf).all()
        assert posterior.log_density(away)[:1] == pytest.approx(expected[:1])
    with pytest.raises(UsageError, match="expected a Posterior"):
        plug.localize(nothing, prior=3)


def test_a_uniform_prior_of_another_grid_rules_nothing_out(plug, cache_dir):
    """Although some stored poses lie a little off the contact pose space."""
    index = open_index(plug.mesh, plug.sensor, None, 6_000, cache_dir, None)
    uniform = Posterior(index, index.possible, index.log_possible_weight)
    mass = prior_log_mass(plug.index, uniform, np.eye(4), "sensor")
    held = plug.index.possible
    assert np.isfinite(mass[held]).all()
    assert np.abs(mass - plug.index.log_weight)[held].max() < 0.01


def test_a_prior_of_a_finer_grid_keeps_its_mass_in_each_place(plug, cache_dir, rng):
    """Of a few narrow peaks, also where a coarse cell's own pose meets some of them and misses the rest."""
    coarse, fine = open_index(plug.mesh, plug.sensor, None, 6_000, cache_dir, None), plug.index
    middle = np.array(coarse.resolution.penetrations)
    met = np.unique(fine.lookup(coarse.poses(coarse.possible), middle[coarse.possible // coarse.places]))
    missed = np.setdiff1d(fine.possible, met)
    cells = np.sort(np.concatenate([rng.choice(met, 12, replace=False), rng.choice(missed, 12, replace=False)]))
    prior = Posterior(fine, cells, np.full(len(cells), -np.log(len(cells))))
    mass = np.exp(prior_log_mass(coarse, prior, np.eye(4), "sensor").astype(float))
    depth = np.array(fine.resolution.penetrations)[cells // fine.places]
    expected = np.bincount(coarse.lookup(fine.poses(cells), depth), minlength=len(coarse)) / len(cells)
    assert mass.sum() == pytest.approx(1, abs=1e-5) and np.abs(mass - expected).sum() / 2 < 0.2


def test_a_prior_of_a_known_contact_face_moves_to_a_coarser_grid_and_back(plug, cache_dir, rng):
    face = open_index(plug.mesh, plug.sensor, [((0, 0, 1), 0.0)], 6_000, cache_dir, None)
    everywhere, there = (Posterior(each, each.possible, each.log_possible_weight) for each in (plug.index, face))
    mass = np.exp(prior_log_mass(plug.index, there, np.eye(4), "sensor").astype(float))
    T, depth = face.space.sample(300, rng)
    assert (mass[plug.index.lookup(T, depth)] > 0).mean() > 0.9
    turned = approach_of(plug.index.poses(np.arange(len(plug.index)))[:, :3, :3])[:, 2] < np.cos(0.6)
    assert mass.sum() == pytest.approx(1, abs=1e-5) and turned.any() and mass[turned].sum() == 0
    back = prior_log_mass(face, everywhere, np.eye(4), "sensor")
    assert np.abs(back[face.possible] - face.log_weight[face.possible]).max() < 0.01
    nothing = plug.localize(np.zeros(plug.sensor.image_size_px[::-1], bool))
    with pytest.raises(InputError, match="does not touch the sensor"):
        prior_log_mass(face, nothing, np.eye(4), "sensor")
