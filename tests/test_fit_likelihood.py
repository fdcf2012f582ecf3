"""The fit of the contact likelihood: settings come back from touches that were drawn with them."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.special import logsumexp

from geomtact.kernels.contact_energy import SHARES
from geomtact.scoring.contact_likelihood import INTERCEPT, POWERS, RATE, SHARE, SLOPE
from tools.training.likelihood import Example, fit

TRUE_RATE = 4.0  # nats/mm^3


def drawn(rng, elastic, poses=120):
    """A touch among poses of any energy, the true one drawn by its likelihood."""
    rigid = rng.uniform(0, 5, poses + 1)
    energy = np.full((poses + 1, SHARES), 1e3, np.float32)
    energy[:, -1] = rigid
    true = rng.choice(poses + 1, p=np.exp(-TRUE_RATE * rigid) / np.exp(-TRUE_RATE * rigid).sum())
    rest = np.delete(np.arange(poses + 1), true)
    zeros = np.zeros(poses)
    return Example(energy[rest], zeros, zeros, energy[true], 0.0, 0.0, elastic)


@pytest.mark.slow
def test_the_rate_that_touches_were_drawn_with_is_fitted():
    """Whatever power bears it: the fitted mixture gains as much as the true rate does, and is as sure as it is right."""
    rng = np.random.default_rng(0)
    examples = [drawn(rng, i % 2 == 1) for i in range(300)]
    found = fit(examples)
    energy = np.array([np.append(e.energy[:, -1], e.true_energy[-1]) for e in examples], float)
    true = -TRUE_RATE * energy[:, -1] - logsumexp(-TRUE_RATE * energy, 1) + np.log(energy.shape[1])
    assert found.gain == pytest.approx(true.mean(), abs=0.1)
    assert found.expected_gain == pytest.approx(found.gain, abs=0.2)
    assert np.abs(np.array(found.coverage[0]) - [0.5, 0.8, 0.9, 0.95]).max() < 0.09


def test_the_package_holds_what_was_fitted():
    folder = Path(__file__).parents[1] / "docs" / "results"
    fitted = json.loads((folder / "contact-likelihood.json").read_text("utf-8"))
    assert pytest.approx(RATE / 1e9, rel=5e-3) == 3 * fitted["rate"]
    assert pytest.approx(SHARE, rel=1e-2) == fitted["share"]
    mixture = json.loads((folder / "mixture.json").read_text("utf-8"))
    for source in INTERCEPT:
        assert pytest.approx(INTERCEPT[source], abs=6e-3) == mixture[source]["intercept"]
        assert pytest.approx(SLOPE[source], abs=6e-3) == mixture[source]["slope"]
    assert list(POWERS) == mixture["powers"]
