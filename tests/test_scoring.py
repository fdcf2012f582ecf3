"""Laws of the scores: brute force agrees, a contact is most like itself, and a score's weight follows its information."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.stats import multivariate_t
from speed import slow_but

from geomtact.contact_space.index import pack
from geomtact.contact_space.store import open_index
from geomtact.errors import MeshError, UsageError
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.mesh_file import load_mesh
from geomtact.log_mass import normalised
from geomtact.scoring import calibration
from geomtact.scoring.calibration import FLOORS, CalibrationTouches, fit_calibration, simulate_touches
from geomtact.scoring.fitted import fitted_scorer
from geomtact.scoring.moments import Moments
from geomtact.scoring.overlap import OVERLAPS, overlaps, to_grid
from geomtact.scoring.probability import Calibration, posterior_log_prob
from geomtact.sensing.moments import moments, without_specks
from geomtact.sensing.sensor import Sensor

SENSOR = Sensor("plain", (320, 240), (6e-5, 6e-5), 0.0, 2e-3)
SHAPE = (48, 64)


def random_masks(n, rng, shape=SHAPE):
    """Blobs of many sizes, nothing and everything among them."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    centre = rng.uniform(0, shape, (n, 2))
    radius = rng.uniform(0, 25, n)
    masks = (y - centre[:, 0, None, None]) ** 2 + (x - centre[:, 1, None, None]) ** 2 < radius[:, None, None] ** 2
    masks[:1], masks[1:2] = False, True
    return masks


def packed(masks, levels=2):
    """Bits (levels, words, n), as an index holds them."""
    n = len(masks) // levels
    return pack(masks[: n * levels].reshape(levels, n, -1)).swapaxes(1, 2).copy()


def test_overlaps_equal_counted_pixels(rng):
    masks, seen = random_masks(40, rng), random_masks(5, rng)[4]
    expected = (masks & seen).sum((1, 2)).reshape(2, 20)
    assert (overlaps(packed(masks), seen) == expected).all()


def test_overlaps_of_many_poses_are_each_their_own(rng):
    """More poses than are compared in one step."""
    masks = random_masks(64, rng)
    many = np.tile(packed(masks, 1), (1, 1, 1100))
    expected = np.tile((masks & masks[7]).sum((1, 2)), 1100)
    assert (overlaps(many, masks[7])[0] == expected).all()


def by_brute_force(scorer, stored, seen):
    both, either = (stored & seen).sum((1, 2)), (stored | seen).sum((1, 2))
    if scorer.name == "iou":
        return both / np.maximum(either, 1)
    return 1 - (either - both) / seen.size


@pytest.mark.parametrize("scorer", list(OVERLAPS.values()), ids=lambda s: s.name)
def test_scores_equal_counted_pixels(scorer, localizer, rng):
    index = localizer.index
    ids = rng.choice(len(index), 300, replace=False)
    stored = index.masks(ids)
    for seen in index.masks(ids[:3]):
        score = scorer.score(index, seen)
        assert score.shape == index.height.shape and score.dtype == np.float32
        assert score.ravel()[ids] == pytest.approx(by_brute_force(scorer, stored, seen), abs=1e-6)


@pytest.mark.parametrize("scorer", list(OVERLAPS.values()), ids=lambda s: s.name)
def test_a_stored_contact_is_most_like_itself(scorer, localizer, rng):
    index = localizer.index
    for i in rng.choice(len(index), 10):
        score = scorer.score(index, index.masks([i])[0]).ravel()
        assert score[i] == 1 and score.max() == 1 and score.min() >= 0


def test_an_image_is_brought_onto_the_grid_by_area(rng):
    small = random_masks(8, rng)[5]
    assert (to_grid(np.kron(small, np.ones((5, 5), bool)), SHAPE) == small).all()
    assert to_grid(np.ones((240, 320), bool), SHAPE).all()
    assert not to_grid(np.zeros((240, 320), bool), SHAPE).any()
    y, x = np.mgrid[:240, :320]
    disk = (x - 150) ** 2 + (y - 100) ** 2 < 60**2
    assert to_grid(disk, SHAPE).mean() == pytest.approx(disk.mean(), rel=0.02)


# --- moments


def ellipse(x=0.0, y=0.0, a=4.0, b=2.0, angle=0.0, shape=(240, 320)):
    """An ellipse of half axes a, b [mm], its long axis ``angle`` [rad] from +x, centred at x, y [mm]."""
    X, Y = np.meshgrid(*(1e3 * c for c in SENSOR.pixel_centres(shape)))
    X, Y = X - x, Y - y
    u, v = X * np.cos(angle) + Y * np.sin(angle), -X * np.sin(angle) + Y * np.cos(angle)
    return (u / a) ** 2 + (v / b) ** 2 < 1


def of(*masks):
    return moments(np.stack(masks), SENSOR).astype(float)


def test_a_shift_moves_the_centroid_only():
    here, there = of(ellipse(), ellipse(x=2.4, y=-1.2))
    half_diagonal = 1e3 * np.hypot(*SENSOR.half_window)
    assert there[:2] - here[:2] == pytest.approx([2.4 / half_diagonal, -1.2 / half_diagonal], abs=1e-4)
    assert there[2:] == pytest.approx(here[2:], abs=2e-3)


def test_a_quarter_turn_reverses_the_stretch():
    for angle in (0.0, 0.3, 1.1):
        here, there = of(ellipse(angle=angle), ellipse(angle=angle + np.pi / 2))
        assert there[4:] == pytest.approx(-here[4:], abs=5e-3)
        assert there[:4] == pytest.approx(here[:4], abs=5e-3)


def test_stretch_points_along_the_long_axis_at_twice_its_angle():
    """An ellipse of axes a : b is stretched by log(a/b); a half turn leaves it as it is."""
    for angle in np.linspace(0, np.pi, 7):
        got = of(ellipse(angle=angle))[0, 4:]
        assert got == pytest.approx(np.log(2) * np.array([np.cos(2 * angle), np.sin(2 * angle)]), abs=0.01)


def test_scaling_adds_to_the_log_area_and_the_log_size():
    small, large = of(ellipse(a=2, b=1), ellipse(a=4, b=2))
    assert large[2] - small[2] == pytest.approx(np.log(4), abs=0.01)
    assert large[3] - small[3] == pytest.approx(np.log(2), abs=0.01)
    assert large[4:] == pytest.approx(small[4:], abs=0.01)
    assert np.exp(small[2]) == pytest.approx(np.pi * 2 * 1e-6 / np.hypot(*SENSOR.half_window) ** 2, rel=0.01)


def test_moments_do_not_depend_on_the_grid():
    assert of(ellipse(1, 1))[0] == pytest.approx(
        moments(ellipse(1, 1, shape=SHAPE)[None], SENSOR)[0].astype(float), abs=0.02
    )


def test_moments_of_anything_are_finite():
    one_pixel = np.zeros(SHAPE, bool)
    one_pixel[3, 5] = True
    line = np.zeros(SHAPE, bool)
    line[3] = True
    for mask in (np.zeros(SHAPE, bool), np.ones(SHAPE, bool), one_pixel, line):
        assert np.isfinite(moments(mask[None], SENSOR)).all()


def test_dust_is_dropped_beside_a_large_contact_and_kept_alone():
    large, speck = ellipse(), ellipse(7, 5, 0.15, 0.15)
    assert (without_specks(large | speck, SENSOR.pixel_area((240, 320))) == large).all()
    assert (without_specks(speck, SENSOR.pixel_area((240, 320))) == speck).all()
    two = ellipse(-4, 0, 2, 2) | ellipse(4, 0, 2, 2)
    assert (without_specks(two, SENSOR.pixel_area((240, 320))) == two).all()
    nothing = np.zeros((240, 320), bool)
    assert (without_specks(nothing, SENSOR.pixel_area((240, 320))) == nothing).all()


def test_dust_is_found_however_much_of_it_there_is():
    """Beside a contact, as many single pixels as fit: more than labels of 16 bits can distinguish, in the larger image."""
    for h, w in ((400, 400), (640, 640)):
        mask = np.zeros((h, w), bool)
        mask[::2, ::2] = True
        mask[100:160, 100:180] = True
        kept = without_specks(mask, 1e-8)
        assert kept[100:160, 100:180].all() and kept.sum() <= 62 * 82


def some_moments(localizer, freedom=5.0):
    bias = np.array([0.01, -0.02, 0.1, 0.03, 0.0, 0.05])
    A = np.random.default_rng(4).normal(size=(6, 6)) * 0.2
    return Moments(bias, A @ A.T + 0.05 * np.eye(6), freedom)


@pytest.mark.parametrize("freedom", [3.0, 5.0, 30.0])
def test_the_likelihood_is_student_t(ball, rng, freedom):
    scorer, index = some_moments(ball, freedom), ball.index
    mask = index.masks([len(index) // 3])[0]
    seen = moments(without_specks(mask, index.sensor.pixel_area(mask.shape))[None], index.sensor)[0]
    ids = rng.choice(len(index), 500)
    expected = multivariate_t(scorer.bias, scorer.covariance, df=freedom).logpdf(seen - index.moments[:, ids].T)
    assert scorer.score(index, mask).ravel()[ids] == pytest.approx(expected, rel=1e-4, abs=2e-3)


def test_fitting_recovers_the_t_distribution_that_was_drawn_from(ball, monkeypatch):
    """Against its stored moments each touch is off by a sample of a given t distribution."""
    rng = np.random.default_rng(3)
    truth = some_moments(ball)
    n = 6000
    off = multivariate_t(truth.bias, truth.covariance, df=5, seed=rng).rvs(n)
    stored = rng.normal(size=(6, n))
    index = SimpleNamespace(moments=stored, sensor=SENSOR)
    seen = iter((stored + off.T).T)
    monkeypatch.setattr("geomtact.scoring.moments.moments_of", lambda mask, sensor: next(seen))
    fitted = Moments.fit(index, [None] * n, np.arange(n))
    spread = np.sqrt(np.diag(truth.covariance))
    assert np.abs((fitted.bias - truth.bias) / spread).max() < 0.08
    assert fitted.covariance == pytest.approx(truth.covariance, abs=0.08 * np.outer(spread, spread).max())


@pytest.mark.parametrize("name", slow_but(("plug", "pin", "curved"), "plug"))
def test_the_scores_rank_the_true_pose_high(name, request):
    """On touches drawn with noise, the true cell is above nine in ten others, by area or by moments."""
    localizer = request.getfixturevalue(name)
    index = localizer.index
    touches = simulate_touches(index, 24, seed=8)
    # the thesis's own, l1, fails, as the thesis reports
    for name, scorer in (("moments", localizer.scorer.evidence_model.moments), ("iou", OVERLAPS["iou"])):
        w = np.asarray(index.weight).ravel()
        above = []
        for mask, true in zip(touches.masks, touches.ids, strict=True):
            score = scorer.score(index, mask).ravel()
            above.append(w[score > score[true]].sum())
        assert np.median(above) < 0.15, (name, index.mesh.name)


# --- what a score is worth


class Useless:
    name = "useless"

    def score(self, index, mask):
        return np.random.default_rng(int(mask.sum())).random(index.height.shape, np.float32)


class Oracle:
    """Has the true cell of each of some touches."""

    name = "oracle"

    def __init__(self, touches):
        self.true = {id(mask): i for mask, i in zip(touches.masks, touches.ids, strict=True)}

    def score(self, index, mask):
        out = np.zeros(index.height.size, np.float32)
        out[self.true[id(mask)]] = 1
        return out.reshape(index.height.shape)


def test_a_useless_score_is_not_trusted(ball):
    index = ball.index
    touches = simulate_touches(index, 40, seed=5)
    useless, iou = (fit_calibration(s, index, touches) for s in (Useless(), OVERLAPS["iou"]))
    assert useless.floor == FLOORS[-1] or useless.temperature > 2
    assert abs(useless.gain) < 0.1
    assert iou.gain > 1
    oracle = fit_calibration(Oracle(touches), index, touches)
    w = np.asarray(index.weight).ravel()[touches.ids]
    assert oracle.floor == FLOORS[0]
    assert oracle.gain == pytest.approx(-np.log(w).mean(), abs=0.01)


def test_the_calibration_is_the_one_that_gains_most(ball):
    """The gain of every temperature and mixture weight, worked out from the posterior that localize would give."""
    index = ball.index
    touches = simulate_touches(index, 12, seed=6)
    found = fit_calibration(OVERLAPS["iou"], index, touches)
    log_w = index.log_weight
    gain = {}
    for t in (0.1 * found.temperature, found.temperature, 10 * found.temperature):
        for floor in (FLOORS[0], found.floor, FLOORS[-1]):
            each = []
            for mask, true in zip(touches.masks, touches.ids, strict=True):
                trust = Calibration(t, floor, 0.0)
                log_prob = posterior_log_prob(OVERLAPS["iou"].score(index, mask), log_w, trust)
                each.append(log_prob[true] - log_w[true])
            gain[t, floor] = np.mean(each)
    assert max(gain.values()) == pytest.approx(gain[found.temperature, found.floor])
    assert found.gain == pytest.approx(gain[found.temperature, found.floor], abs=0.01)


def test_the_posterior_is_bayes_rule_with_a_share_of_the_prior(rng):
    score = rng.normal(size=(2, 500)).astype(np.float32) * 5
    log_prior = np.log(rng.random(1000)).astype(np.float32)
    log_prior[:50] = -np.inf
    log_prior = normalised(log_prior)
    assert np.exp(log_prior).sum() == pytest.approx(1, abs=1e-5)
    for floor in (0.001, 0.01, 0.5):
        log_prob = posterior_log_prob(score, log_prior, Calibration(3.0, floor, 0.0))
        prior = np.exp(log_prior.astype(float))
        joint = np.exp(score.ravel().astype(float) / 3) * prior
        assert np.exp(log_prob) == pytest.approx((1 - floor) * joint / joint.sum() + floor * prior, rel=1e-4)
        assert np.exp(log_prob).sum() == pytest.approx(1, abs=1e-5)
        assert (log_prob[:50] == -np.inf).all()


def test_simulated_touches_lie_in_their_stated_cells(plug):
    touches = simulate_touches(plug.index, 20, seed=7)
    again = simulate_touches(plug.index, 20, seed=7)
    assert (touches.ids == again.ids).all()
    assert all((a == b).all() for a, b in zip(touches.masks, again.masks, strict=True))
    assert len(touches.masks) == 20 and all(m.any() for m in touches.masks)
    w = np.asarray(plug.index.weight).ravel()
    assert (w[touches.ids] > 0).all()


def test_a_touch_that_comes_out_otherwise_changes_no_other(plug, monkeypatch):
    """A draw that one processor rejects and another takes must not give all later touches other random numbers."""
    touches = simulate_touches(plug.index, 12, seed=7)
    simulate, calls = calibration._simulated_mask, iter(range(12))

    def but_the_first(*given):
        if next(calls) == 0:
            simulate(*given)
        return simulate(*given)

    monkeypatch.setattr(calibration, "_simulated_mask", but_the_first)
    others = simulate_touches(plug.index, 12, seed=7)
    same = [np.array_equal(a, b) for a, b in zip(touches.masks, others.masks, strict=True)]
    assert same == [False] + 11 * [True] and (touches.ids[1:] == others.ids[1:]).all()


@pytest.mark.slow
def test_simulated_touches_are_as_often_where_a_cell_hardly_touches_as_poses_are(cache_dir):
    """A plate on a sensor with a housing: a little tilt lets its far end strike, so that many a pose lies in a
    cell of which little touches at the cell's rotation."""
    solid = trimesh.creation.box((60e-3, 40e-3, 2e-3))
    plate = Mesh(solid.vertices, solid.faces, "plate", "m").with_symmetry()
    index = open_index(plate, Sensor.load("gelsight-mini"), None, 20_000, cache_dir, None)
    little = index.touching < 0.5
    poses = index.lookup(*index.space.sample(2000, np.random.default_rng(1)))
    touches = simulate_touches(index, 250, seed=2).ids
    expected, found = (little[ids % index.places].mean() for ids in (poses, touches))
    assert expected > 0.1
    assert found == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) * (1 / 250 + 1 / 2000)))


def test_touches_are_kept_and_read_back(plug, tmp_path):
    touches = simulate_touches(plug.index, 5, seed=7)
    touches.save(tmp_path / "touches.npz")
    again = CalibrationTouches.load(tmp_path / "touches.npz")
    assert (touches.ids == again.ids).all() and (np.array(touches.masks) == np.array(again.masks)).all()


@pytest.mark.parametrize("damage", ["", "{}", "not json", json.dumps({"format": 999})])
def test_a_damaged_fit_is_made_anew(ball, tmp_path, monkeypatch, damage):
    monkeypatch.setattr("geomtact.scoring.fitted.TOUCHES", 50)
    (tmp_path / "iou.json").write_text(damage)
    assert fitted_scorer("iou", ball.index, tmp_path).scorer.name == "iou"
    assert set(json.loads((tmp_path / "iou.json").read_text())["calibration"]) == {"temperature", "floor", "gain"}


def test_an_unknown_score_names_the_nearest(ball):
    with pytest.raises(UsageError, match="no score named 'moment'; did you mean 'moments'"):
        fitted_scorer("moment", ball.index)


@pytest.mark.slow
def test_an_object_whose_touches_are_all_equal_is_refused(make_localizer, monkeypatch, tmp_path):
    """A slab that lies on its face fills the window nearly everywhere: only its rim is informative."""
    trimesh.creation.box((200, 200, 20)).export(tmp_path / "slab.stl")
    slab = load_mesh(tmp_path / "slab.stl", "mm")
    monkeypatch.setattr("geomtact.scoring.fitted._LEAST_GAIN", 1.5)  # its rim is more informative than the usual limit
    with pytest.raises(
        MeshError, match="^slab: cannot be localized.* all alike: at [5-9]. % .* fills the window"
    ) as error:
        make_localizer(slab, "gelsight-mini", approach=[((0, 0, 1), 0.0)], max_poses=5_000, cache_dir=tmp_path)
    assert "a larger window" in str(error.value) and "\n" not in str(error.value)
    assert not list(tmp_path.glob("*/encoder*.json"))


# --- probabilities in a mask's stead


def test_a_possible_contact_pixel_counts_by_its_probability(plug, a_touch):
    """Half of a patch beside the contact moves the moments half as far as all of it."""
    _, mask = a_touch(plug)
    beside = np.zeros_like(mask)
    beside[:40, :60] = True
    sums = [m.astype(np.float32) for m in (mask, mask + 0.4 * beside, mask | beside)]
    centre, area = zip(*[(m[:2], np.exp(m[2])) for m in moments(np.stack(sums), plug.sensor)], strict=True)
    first, some, all_of_it = (c * a for c, a in zip(centre, area, strict=True))
    assert some - first == pytest.approx(0.4 * (all_of_it - first), rel=1e-3)


def test_dust_is_dust_by_its_probability_too():
    probability = np.full((100, 100), 0.1, np.float32)
    probability[20:60, 20:60], probability[80:82, 80:82] = 0.9, 0.7
    clean = without_specks(probability, 1e-8)
    assert (clean[80:82, 80:82] == 0).all()
    clean[80:82, 80:82] = 0.7
    assert np.array_equal(clean, probability)
