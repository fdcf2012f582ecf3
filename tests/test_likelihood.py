"""Laws of the pixel likelihood: brute force agrees, the true pose is likely, thresholds and softness are averaged over."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from geomtact.contact_space.index import pack
from geomtact.scoring.likelihood import SOFTNESS, THRESHOLDS, PixelLikelihood, _contact_probability
from geomtact.sensing.sensor import Sensor

MM = 1e-3
SENSOR = Sensor("plain", (32, 24), (0.5 * MM, 0.5 * MM), 0.0, 2 * MM)
DEPTHS = (0.25 * MM, 0.75 * MM, 1.25 * MM, 1.75 * MM)


def stored_cones(n, rng):
    """An index of ``n`` places whose contacts are the contour lines of cones, and the depth at which each cone is touched [m]."""
    y, x = np.mgrid[:24, :32]
    centre = rng.uniform((6, 8), (18, 24), (n, 2))
    needed = (
        np.hypot(y - centre[:, 0, None, None], x - centre[:, 1, None, None]) * rng.uniform(0.1, 0.4, (n, 1, 1)) * MM
    )
    masks = needed[None] <= np.array(DEPTHS)[:, None, None, None]
    index = SimpleNamespace(
        sensor=SENSOR,
        resolution=SimpleNamespace(penetrations=DEPTHS, mask_shape=(24, 32)),
        bits=pack(masks.reshape(4, n, -1)).swapaxes(1, 2).copy(),
        area=masks.sum((2, 3)).astype(np.uint16),
        height=np.zeros((4, n), np.float32),
    )
    return index, masks, needed


def test_it_equals_the_sum_over_pixels(rng):
    index, masks, _ = stored_cones(9, rng)
    seen = masks[2, 4]
    score = PixelLikelihood().score(index, seen)
    weight = min(1.0, 0.25e-6 / 4e-6)
    for p, i in product(range(4), range(9)):
        contour = 4 - masks[:, i].sum(0)  # the first penetration at which each pixel is in contact
        below = DEPTHS[p] - contour * 0.5 * MM
        each = []
        for t, s in product(THRESHOLDS, SOFTNESS):
            yes = _contact_probability(below - t * DEPTHS[p], s)
            each.append(weight * np.where(seen, np.log(yes), np.log(1 - yes)).sum())
        assert score[p, i] == pytest.approx(np.log(np.mean(np.exp(each))), abs=1e-3)


def test_the_pose_that_made_the_contact_is_the_most_likely(rng):
    index, masks, needed = stored_cones(40, rng)
    hits = []
    for i in range(40):
        for share in (0.0, 0.5):  # rigid, and as a gel would show it
            felt = needed[i] <= (1 - share) * DEPTHS[2]
            if felt.sum() > 12:
                score = PixelLikelihood().score(index, felt)
                hits.append(int(np.unravel_index(score.argmax(), score.shape)[1] == i))
    assert len(hits) > 40 and np.mean(hits) > 0.9


def test_probabilities_of_a_pixel_lie_between_0_and_1():
    below = np.linspace(-1, 1, 201) * 20 * MM
    for s in SOFTNESS:
        yes = _contact_probability(below, s)
        assert ((yes > 0) & (yes < 1)).all() and (np.diff(yes) >= 0).all()
        assert _contact_probability(np.zeros(1), s) == pytest.approx(0.5)


@pytest.mark.slow
def test_a_fine_grid_localizes_the_object(make_localizer):
    """One exact face, so that a cell is a few millimetres wide: finer than the thesis's pixel distance resolves."""
    face = [((0, 0, 1), 0.0)]
    gain = {}
    for name in ("likelihood", "l1"):
        localizer = make_localizer("connector_plug", "gelslim", approach=face, max_poses=40_000, scorer=name)
        gain[name] = localizer.scorer.calibration.gain
    assert gain["likelihood"] > max(1.5, gain["l1"])
