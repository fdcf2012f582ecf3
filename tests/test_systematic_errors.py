"""Errors that a whole contact has in common: how they are distributed, and how they move a pose."""

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import kstest

from geomtact import se3
from geomtact.contact_space.cell_transfer import ExtrinsicsStd
from geomtact.inference.systematic_errors import (
    ERRORS,
    NODES,
    NODES_BESIDE,
    displaced,
    nodes,
    nodes_beside,
    random_errors,
    stand_of,
    undisplaced,
)
from geomtact.scoring.contact_likelihood import SCALE_ERROR, SHIFT_ERROR

WIDTH = np.array([SCALE_ERROR] + 3 * [SHIFT_ERROR])


def share(errors):
    """Which share of the distribution is below ``errors`` (n, 4)."""
    return 0.5 + 0.5 * np.arctan(errors / WIDTH) / np.arctan(40)


def test_errors_are_drawn_from_their_distribution():
    of_all = share(random_errors(20_000, np.random.default_rng(0)))
    assert all(kstest(each, "uniform").pvalue > 1e-3 for each in of_all.T)


def test_nodes_have_the_distribution():
    """Shifts lie in the middle of every share of it, errors of the scale farther apart; their weights make up for that."""
    errors, log_weight = nodes()
    weight = np.exp(log_weight)
    assert weight.sum() == pytest.approx(1)
    for each in share(errors)[:, 1:].T:
        np.testing.assert_allclose(np.sort(each), (np.arange(NODES) + 0.5) / NODES, atol=1e-12)
    order = np.argsort(errors[:, 0])
    middle = np.cumsum(weight[order]) - 0.5 * weight[order]
    np.testing.assert_allclose(share(errors)[order, 0], middle, atol=0.01)
    assert errors[:, 0].max() > 20 * SCALE_ERROR


def test_sensors_stand_where_they_are_said_to_within_what_is_known_of_it():
    """By the middle of all shares they stand right; stated uncertainties are those of normal distributions, with 0.1 mm and
    degrees of the contact's own; else the logarithm of the standard deviation is uniform from 0.2 to 3 mm and degrees."""
    np.testing.assert_array_equal(stand_of(np.full((1, ERRORS), 0.5)), np.eye(4)[None])
    shares = np.random.default_rng(0).random((20_000, ERRORS))
    stated = se3.log(stand_of(shares, ExtrinsicsStd(0.02, 1e-3)))
    for each, std in zip(stated.T, [np.hypot(0.02, np.deg2rad(0.1))] * 3 + [np.hypot(1e-3, 1e-4)] * 3, strict=True):
        assert kstest(each / std, "norm").pvalue > 1e-3
    shares[:, 1:] = ndtr(1.0)
    unknown = np.abs(se3.log(stand_of(shares)))
    low, high = unknown.min(0), unknown.max(0)
    np.testing.assert_allclose(low[3:], 0.2e-3, rtol=0.05)
    np.testing.assert_allclose(high[:3], np.deg2rad(3), rtol=0.05)
    assert nodes_beside(None).shape == (NODES_BESIDE, 4, 4)
    assert kstest(np.log(unknown[:, 0] / low[0]) / np.log(high[0] / low[0]), "uniform").pvalue > 1e-3


def test_errors_are_undone():
    rng = np.random.default_rng(1)
    centre, errors, about = rng.normal(size=(50, 3)), random_errors(50, rng), rng.normal(size=3)
    np.testing.assert_allclose(undisplaced(displaced(centre, errors, about), errors, about), centre, atol=1e-12)


def test_a_larger_object_has_its_centre_farther_from_the_contact():
    centre, about = np.array([0.03, -0.02, 0.04]), np.array([0.003, 0.001, 0.0])
    moved = displaced(centre, np.array([np.log(1.01), 0, 0, 1e-4]), about)
    assert moved - about == pytest.approx(1.01 * (centre - about) + [0, 0, 1e-4])
