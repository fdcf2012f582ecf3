"""Laws of contacts of several patches: their likelihood is a mixture, and a single patch is scored as it always was."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import softmax

from geomtact.scoring.mixture import contact_hypotheses, mix_hypotheses
from geomtact.scoring.probability import Calibration, posterior_log_prob
from geomtact.sensing.patches import patches

MM = 1e-3


@pytest.fixture(scope="module")
def localizer(make_localizer):
    return make_localizer("bracket", "gelslim", scorer="encoder")


def two_patches(localizer):
    """A contact of 4 by 4 mm and one of 2 by 3 mm beside it."""
    mask = np.zeros(localizer.sensor.image_size_px[::-1], bool)
    x, y = (c / MM for c in localizer.sensor.pixel_centres())
    X, Y = np.meshgrid(x, y)
    left, right = (abs(X + 5) < 2) & (abs(Y) < 2), (abs(X - 4) < 1) & (abs(Y - 1) < 1.5)
    return mask | left | right, [left, right]


def test_patches_are_the_components_of_the_mask_largest_first(rng):
    mask = rng.random((90, 120)) > 0.55
    pixel_area = 0.3e-6 / 7.5  # eight pixels count, seven do not
    found = patches(mask, pixel_area)
    sizes = [patch.sum() for patch in found]
    assert len(found) > 3 and sizes == sorted(sizes, reverse=True) and min(sizes) >= 8
    together = np.sum(found, 0)
    assert (together <= mask).all()
    assert not patches(mask & (together == 0), pixel_area)
    assert all(len(patches(patch, pixel_area)) == 1 for patch in found)


def test_patches_keep_their_probabilities(localizer):
    mask, parts = two_patches(localizer)
    shown = np.where(mask, np.float32(0.8), np.float32(0.1))
    found = patches(shown, localizer.sensor.pixel_area(mask.shape))
    for each, patch in zip(found, parts, strict=True):
        assert np.array_equal(each, np.where(patch, np.float32(0.8), np.float32(0)))
        assert each.dtype == np.float32


def test_one_patch_is_left_unchanged(localizer):
    mask, (left, right) = two_patches(localizer)
    dirt = left.copy()
    dirt[:2, :2] = True
    for alone in (left, right, dirt, np.zeros_like(mask), np.ones_like(mask)):
        shares, shown = contact_hypotheses(alone, localizer.sensor)
        assert shares == [1.0] and shown[0] is alone


def test_the_shares_of_several_patches_add_up_to_one(localizer):
    for number in (2, 3, 5):
        mask = np.zeros(localizer.sensor.image_size_px[::-1], bool)
        for i in range(number):
            mask[20:60, 30 + 50 * i : 60 + 50 * i] = True
        shares, shown = contact_hypotheses(mask, localizer.sensor)
        assert sum(shares) == pytest.approx(1, rel=1e-12) and min(shares) > 0
        assert shown[0] is mask and len(shown) == len(shares) == 1 + min(number, 3)


def test_the_posterior_of_a_mixture_is_the_mixture_of_the_posteriors(rng):
    """Under the measure that each likelihood was normalised by, however far the scores reach."""
    shares, temperature = [0.7, 0.2, 0.1], 0.37
    scores = [(rng.normal(size=500) * 40).astype(np.float32) for _ in shares]
    log_weight = np.log(rng.dirichlet(np.ones(500)) + 1e-300).astype(np.float32)
    log_weight[:20] = -np.inf
    expected = sum(s * softmax(x / temperature + log_weight) for s, x in zip(shares, scores, strict=True))
    score = mix_hypotheses(shares, [x.copy() for x in scores], log_weight, temperature)
    got = posterior_log_prob(score, log_weight, Calibration(temperature, 0.0, 1.0))
    assert np.exp(got) == pytest.approx(expected, rel=1e-4, abs=1e-12)
    assert (np.exp(got)[:20] == 0).all()


def mixture(shares, scores, weight, temperature):
    """Density (N,) of the mixture over rows of measure ``weight`` (N,), whose scores are (k, N)."""
    likely = [np.exp((x - x.max()) / temperature) for x in np.asarray(scores, float)]
    return sum(share * each / (each @ weight) for share, each in zip(shares, likely, strict=True))


def density(rows):
    """The densities of rows before the uniform mixture weight (N,), and their measure (N,)."""
    log_prob = posterior_log_prob(rows.score, rows.log_prior, replace(rows.calibration, floor=0.0))
    return np.exp((log_prob - rows.log_prior).astype(float)), np.exp(rows.log_prior.astype(float))


@pytest.fixture(scope="module")
def contact(localizer):
    """A contact of two patches, each of them, and the shares of the mixture."""
    mask, parts = two_patches(localizer)
    return mask, parts, contact_hypotheses(mask, localizer.sensor)[0]


@pytest.fixture(params=[1.0, 0.3])
def fit(request, localizer, contact):
    """The localizer's scorer; and one for which contacts so far off are unusual, so that it trusts its scores for less."""
    fit = localizer.scorer
    if request.param == 1:
        return fit
    mask, parts, _ = contact
    nearest = [-fit.scorer.score(localizer.index, each).max() for each in (mask, *parts)]
    encoder = replace(fit.scorer, usual=request.param * min(nearest))
    assert len({encoder.trust(-each) for each in nearest}) == 3
    return replace(fit, scorer=encoder)


@pytest.mark.parametrize("above", [0.0, 0.7 * MM])
def test_cells_are_scored_by_the_mixture(localizer, fit, contact, above):
    """Of contour lines too: each patch belongs to as much deeper poses."""
    index = localizer.index
    mask, parts, shares = contact
    said, weight = density(fit.rows(index, mask, above=above))
    deeper = round(above * len(index.height) / index.sensor.max_penetration)
    scores = []
    for each in (mask, *parts):
        score = fit.scorer.score(index, each)
        lowest = np.full_like(score[:deeper], score.min())
        scores.append(np.concatenate([lowest, score[: len(score) - deeper]]).ravel()[index.possible])
    assert (deeper > 0) == (above > 0)
    assert said == pytest.approx(mixture(shares, scores, weight, fit.calibration.temperature), rel=1e-3)


def test_a_prior_weighs_the_mixture_and_does_not_change_it(localizer, rng):
    """Scores of the cells are those without a prior: the prior is not included in the likelihood."""
    fit, index = localizer.scorer, localizer.index
    mask, _ = two_patches(localizer)
    prior = np.full(len(index), -np.inf)
    known = np.sort(rng.choice(index.possible, 300, replace=False))
    prior[known] = -np.log(300)
    free, bound = (fit.rows(index, mask, each) for each in (None, prior))
    assert np.array_equal(bound.cells, known)
    assert np.array_equal(bound.score, free.score[np.searchsorted(free.cells, known)])
