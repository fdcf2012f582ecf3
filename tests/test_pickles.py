"""A localizer and its posteriors go to other processes and come back the same; one that cannot is an error."""

import copy
import multiprocessing
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
from speed import slow_but

from geomtact import GaussianPrior
from geomtact.contact_space import store
from geomtact.errors import CacheError, InputError
from geomtact.inference.effort import GRID_ALONE
from geomtact.scoring.probability import Calibration
from geomtact.se3 import transform

WAYS = {"pickled": lambda each: pickle.loads(pickle.dumps(each)), "copied": copy.deepcopy}


def downwards(T):
    """A prior that can be pickled: a function of a module."""
    return -T[:, 2, 3]


def check_same(a, b):
    """To the last bit, every result of a posterior."""
    assert (a.frame, a.contact, a.seed, a.warnings, a.log_evidence) == (
        b.frame,
        b.contact,
        b.seed,
        b.warnings,
        b.log_evidence,
    )
    assert np.array_equal(a.cells, b.cells) and np.array_equal(a.log_prob, b.log_prob)
    for one, other in zip(a.modes(3), b.modes(3), strict=True):
        assert one.probability == other.probability
        for name in ("T", "covariance", "observable"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
    if a.contact:
        T = a.sample(5, 1)
        assert np.array_equal(T, b.sample(5, 1)) and np.array_equal(a.log_density(T), b.log_density(T))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", slow_but(["plug", "pin", "flat_nut"], "flat_nut"))
def test_an_unpickled_localizer_gives_the_same_posterior(name, way, request, a_touch):
    localizer = request.getfixturevalue(name)
    T, mask = a_touch(localizer)
    before = localizer.localize(mask, prior=GaussianPrior(T, np.diag(np.repeat([0.2, 4e-3], [3, 3])) ** 2))
    before.modes(1)  # scenes and all that is kept for later are there
    again = WAYS[way](localizer)
    check_same(localizer.localize(mask), again.localize(mask))
    check_same(before, WAYS[way](before))
    assert np.array_equal(localizer.simulate(T).height, again.simulate(T).height)
    assert np.array_equal(WAYS[way](localizer.space).penetration(T[None]), localizer.space.penetration(T[None]))


def test_a_pickle_refers_to_the_cache_which_a_process_reads_once(flat_nut, a_touch):
    text = pickle.dumps(flat_nut)
    stored = flat_nut.index.bits.nbytes + flat_nut.index.moments.nbytes
    assert len(text) < 0.5 * stored
    assert pickle.loads(text) is pickle.loads(text)
    posterior = flat_nut.localize(a_touch(flat_nut)[1], effort=GRID_ALONE)
    _ = posterior.poses, posterior.entropy_nats
    assert len(pickle.dumps(posterior)) < 0.5 * stored
    assert pickle.loads(pickle.dumps(posterior)).index is pickle.loads(text).index


def test_sensors_that_only_differ_in_how_their_images_are_read_stay_apart(flat_nut):
    """They share an index, and are equal as far as contacts go."""
    turned = replace(flat_nut.sensor, camera_rotation_deg=180)
    other = replace(flat_nut, index=replace(flat_nut.index, sensor=turned))
    loaded = [pickle.loads(pickle.dumps(each)).sensor.camera_rotation_deg for each in (flat_nut, other, flat_nut)]
    assert loaded == [0, 180, 0]


@pytest.mark.parametrize("start", ["spawn", "fork"])
def test_a_pool_of_processes_localizes(flat_nut, a_touch, start):
    mask = a_touch(flat_nut)[1]
    masks = [mask, np.roll(mask, 5, axis=1)]
    with multiprocessing.get_context(start).Pool(1) as pool:
        found = pool.map(flat_nut.localize, masks)
    for shown, there in zip(masks, found, strict=True):
        check_same(flat_nut.localize(shown), there)


def test_without_a_cache_everything_is_in_the_pickle(flat_nut, a_touch):
    alone = replace(flat_nut, index=replace(flat_nut.index, folder=None))
    assert len(pickle.dumps(alone)) > flat_nut.index.deflated.nbytes
    mask = a_touch(flat_nut)[1]
    check_same(flat_nut.localize(mask), pickle.loads(pickle.dumps(alone)).localize(mask))


def test_several_sensors_come_along(flat_nut, a_touch):
    mask = a_touch(flat_nut)[1]
    both = replace(flat_nut, others=(flat_nut,))
    again = pickle.loads(pickle.dumps(both))
    images, at = [mask, np.zeros_like(mask)], [np.eye(4), transform(np.eye(3), [0, 0, -0.3])]
    options = {"T_world_sensor": at, "effort": "fast"}
    check_same(both.localize(images, **options), again.localize(images, **options))


def test_a_missing_or_different_cache_is_one_line(make_localizer, flat_nut, cache_dir, tmp_path):
    shutil.copytree(cache_dir / flat_nut.index.key, tmp_path / flat_nut.index.key)
    elsewhere = make_localizer("hex_nut", "gelsight-mini", approach=[((0, 0, 1), 0.0)], cache_dir=tmp_path)
    text = pickle.dumps(elsewhere)
    other = replace(elsewhere, scorer=replace(elsewhere.scorer, calibration=Calibration(1.0, 0.5, 0.0)))
    with pytest.raises(CacheError, match="its score 'encoder' is not the one that was pickled; prepare") as caught:
        pickle.loads(pickle.dumps(other))
    assert "\n" not in str(caught.value)
    shutil.rmtree(tmp_path / flat_nut.index.key)
    store._REOPENED.clear()
    with pytest.raises(
        CacheError, match="the index of 'hex_nut' on 'gelsight-mini', which a pickle refers to"
    ) as caught:
        pickle.loads(text)
    assert "\n" not in str(caught.value)


def test_a_prior_is_pickled_where_possible_and_else_the_error_is_one_line(flat_nut, a_touch):
    T, mask = a_touch(flat_nut)
    nothing, away = np.zeros_like(mask), T.copy()
    away[2, 3] += 0.1
    for prior in (downwards, (away[None], [-1.0]), GaussianPrior(away, 1e-4 * np.eye(6)), None):
        posterior = flat_nut.localize(nothing, prior=prior)
        again = pickle.loads(pickle.dumps(posterior))
        assert again.log_density(away) == posterior.log_density(away) > -np.inf
    unnamed = flat_nut.localize(nothing, prior=lambda T: -T[:, 2, 3])
    with pytest.raises(InputError, match="prior: this function cannot be pickled, and a posterior without") as caught:
        pickle.dumps(unnamed)
    assert "\n" not in str(caught.value)
    assert copy.deepcopy(unnamed).log_density(away) == unnamed.log_density(away)
    touched = flat_nut.localize(mask, prior=lambda T: -T[:, 2, 3], effort=GRID_ALONE)
    check_same(touched, pickle.loads(pickle.dumps(touched)))
