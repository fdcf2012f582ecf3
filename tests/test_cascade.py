"""Laws of coarse to fine: blocks partition the grid, keep its mass, and what is expanded is what a full pass gives."""

import numpy as np
import pytest

from geomtact.contact_space.index import expand_runs
from geomtact.geometry.rotations import Directions
from geomtact.inference.distribution import cell_log_density
from geomtact.inference.posterior import Posterior
from geomtact.scoring import fitted
from geomtact.scoring.cascade import CoarseScorer, heaviest
from geomtact.scoring.encoder import EncoderScorer
from geomtact.scoring.probability import posterior_log_prob
from geomtact.se3 import transform


@pytest.fixture(scope="module")
def localizer(make_localizer):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitted, "_LARGE", 0)
        return make_localizer("bracket", "gelslim", scorer="encoder")


def posterior_of(localizer, rows):
    log_prob = posterior_log_prob(rows.score, rows.log_prior, rows.calibration)
    return Posterior(localizer.index, rows.first, log_prob, runs=rows.runs)


def some_mask(localizer, rng):
    T, _ = localizer.space.sample(1, rng)
    return localizer.simulate(T[0]).mask, T[0]


def test_runs_are_spelled_out_as_one_by_one(rng):
    counts = rng.integers(0, 5, 30)
    first = rng.integers(0, 1000, 30)
    expected = [f + i for f, n in zip(first, counts, strict=True) for i in range(n)]
    assert expand_runs(first, counts).tolist() == expected


def test_a_block_is_a_cell_of_the_next_coarser_grid(localizer):
    """2 x 2 lattice cells of the rotations that one rotation of the level above holds."""
    index = localizer.index
    size = np.diff(index.blocks)
    assert index.blocks[0] == 0 and index.blocks[-1] == index.places and (size > 0).all()
    disks = index.directions.cells.disks
    coarse = Directions.make(index.mesh.symmetry, index.approach, index.resolution.level - 1, disks=disks)
    _, k, j = coarse.lookup(transform(index.rotations, np.zeros(3)))
    parent = (coarse.first_turn[k] + j)[index.rotation]
    x, y = index.lattice(index.shift.astype(float))
    key = np.stack([parent, x // 2, y // 2], 1)
    block = np.repeat(np.arange(len(size)), size)
    for column in range(3):
        low = np.minimum.reduceat(key[:, column], index.blocks[:-1])
        high = np.maximum.reduceat(key[:, column], index.blocks[:-1])
        assert (low == high).all()
    assert len(np.unique(key, axis=0)) == len(size)
    ids = np.arange(len(index))
    first, counts = index.coarse_runs
    assert (np.repeat(np.arange(len(first)), counts) == index.coarse_cell_of(ids)).all()
    assert (index.coarse_cell_of(ids) % len(size) == block[ids % index.places]).all()


def test_the_mass_of_runs_is_that_of_their_cells(localizer, rng):
    index = localizer.index
    w = np.asarray(index.weight, float).ravel()
    first, counts = index.coarse_runs
    expected = np.add.reduceat(w, first)
    assert index.mass(first, counts) == pytest.approx(expected, abs=1e-12)
    assert np.exp(index.log_coarse_weight).sum() == pytest.approx(1, abs=1e-5)
    many = np.flatnonzero(expected > 0)
    some = rng.choice(many, 300)
    hit = index.within_runs(first[some], counts[some], rng.random(300))
    assert ((hit >= first[some]) & (hit < first[some] + counts[some])).all()
    assert (w[hit] > 0).all()


def test_a_blocks_score_is_the_mean_likelihood_of_normal_vectors(localizer, rng):
    index, d, temperature = localizer.index, 3, 0.7
    n = len(index)
    first, counts = index.coarse_runs
    middle = np.repeat(rng.normal(size=(len(first), d)), counts, axis=0)
    spread = np.repeat(rng.uniform(0, 0.4, len(first)), counts)

    class Given(EncoderScorer):
        def seen(self, index, mask):
            return np.array([0.3, -0.2, 0.5], np.float32)

    w = np.maximum(np.asarray(index.weight, float).ravel(), 1e-30)
    found, exact = [], []
    for _ in range(4):  # a block of a dozen is a coarse sample of the normal
        stored = (middle + np.sqrt(spread)[:, None] * rng.normal(size=(n, d))).astype(np.float32)
        scorer = Given(None, stored)
        score = scorer.score(index, None).ravel() / temperature
        exact.append(np.log(np.add.reduceat(w * np.exp(score), first) / np.add.reduceat(w, first)) * temperature)
        found.append(CoarseScorer.make(scorer, index, temperature).score(index, None))
    found, exact = np.mean(found, 0), np.mean(exact, 0)
    large = counts >= 12
    assert large.sum() > 50
    assert np.corrcoef(found[large], exact[large])[0, 1] > 0.98
    assert abs(np.mean(found[large] - exact[large])) < 0.1
    # without spread it is the cells' own score
    same = CoarseScorer.make(Given(None, middle.astype(np.float32)), index, temperature)
    one = Given(None, middle.astype(np.float32)).score(index, None).ravel()[first]
    assert same.score(index, None) == pytest.approx(one, rel=1e-3, abs=1e-3)


def test_scores_that_are_trusted_less_are_those_of_nearer_vectors(localizer, rng):
    """A factor a on squared distances is a factor sqrt(a) on vectors, in a block too."""
    index, by = localizer.index, np.float32(0.3)
    stored = rng.normal(size=(len(index), 4)).astype(np.float32)
    seen = rng.normal(size=4).astype(np.float32)

    class Far(EncoderScorer):
        def trust(self, best):
            return by

    class Near(EncoderScorer):
        def trust(self, best):
            return np.float32(1)

    score, trust = CoarseScorer.make(Far(None, stored), index, 0.7).trusted(index, seen)
    scaled = CoarseScorer.make(Near(None, np.sqrt(by) * stored), index, 0.7)
    assert trust == by
    assert score == pytest.approx(scaled.trusted(index, np.sqrt(by) * seen)[0], rel=1e-3, abs=1e-3)


def test_blocks_are_as_many_poses_as_their_cells(localizer, rng):
    mask, _ = some_mask(localizer, rng)
    blocks = posterior_of(localizer, localizer.scorer.rows(localizer.index, mask, "coarse"))
    cells = expand_runs(blocks.cells, blocks.runs)
    w = np.asarray(localizer.index.weight, float).ravel()[cells]
    each = np.repeat(np.exp(blocks.log_prob.astype(float)), blocks.runs)
    total = np.repeat(localizer.index.mass(blocks.cells, blocks.runs), blocks.runs)
    p = each * w / total
    single = Posterior(localizer.index, cells[p > 0], np.log(p[p > 0]))
    assert blocks.effective_poses == pytest.approx(single.effective_poses, rel=1e-4)


def test_the_heaviest_hold_their_share_and_hardly_more(rng):
    mass = np.exp(rng.normal(0, 3, 5000)).astype(np.float32)
    for share in (0.1, 0.5, 0.9, 0.99):
        chosen = heaviest(mass, share)
        total = mass.sum()
        assert mass[chosen].sum() >= share * total * (1 - 1e-5)
        assert mass[chosen].min() >= mass[~chosen].max() * np.exp(-0.021)
        assert (
            mass[chosen].sum() - share * total <= mass[np.abs(np.log(mass / mass[chosen].min())) < 0.021].sum() * 1.001
        )


def test_rows_cover_the_grid_and_cells_get_their_full_score(localizer, rng):
    index, scorer = localizer.index, localizer.scorer
    mask, _ = some_mask(localizer, rng)
    every = scorer.rows(index, mask, "all")
    full = scorer.scorer.score(index, mask).ravel()
    possible = np.flatnonzero(np.asarray(index.weight).ravel())
    assert every.runs is None and (every.first == possible).all()
    first, counts = index.coarse_runs
    blocks, some = scorer.rows(index, mask, "coarse"), scorer.cascade.expanded(index, mask)
    for rows in (blocks, some):
        spelled = expand_runs(rows.first, rows.runs)
        assert (np.diff(spelled) > 0).all() and np.isin(possible, spelled).all()
        assert np.exp(rows.log_prior.astype(float)).sum() == pytest.approx(1, abs=1e-4)
    assert len(blocks.first) < len(some.first) < len(index)
    alone = np.isin(some.first, first[counts == 1])  # a block of one cell is a run of one, expanded or not
    single = (some.runs == 1) & ~alone
    assert single.any() and (some.runs > 1).any()
    assert some.score[single] == pytest.approx(full[some.first[single]], rel=1e-4, abs=1e-4)
    assert (some.log_prior[single] == index.log_weight[some.first[single]]).all()
    whole = some.runs > 1
    block = np.searchsorted(blocks.first, some.first[whole])
    assert some.score[whole] == pytest.approx(blocks.score[block], rel=1e-5, abs=1e-5)


def test_a_posterior_on_runs_is_the_same_distribution_cell_by_cell(localizer, rng):
    index = localizer.index
    mask, T = some_mask(localizer, rng)
    coarse = posterior_of(localizer, localizer.scorer.cascade.expanded(index, mask))
    w = np.asarray(index.weight, float).ravel()
    ids = expand_runs(coarse.cells, coarse.runs)
    share = w[ids] / np.repeat(index.mass(coarse.cells, coarse.runs), coarse.runs)
    with np.errstate(divide="ignore"):
        log_prob = np.repeat(coarse.log_prob, coarse.runs) + np.log(share)
    kept = np.isfinite(log_prob)
    single = Posterior(index, ids[kept], log_prob[kept])
    assert coarse.entropy_nats == pytest.approx(single.entropy_nats, abs=1e-4)
    assert coarse.log_density(T) == pytest.approx(single.log_density(T), abs=1e-5)
    some, _ = localizer.space.sample(40, rng)
    assert coarse.log_density(some) == pytest.approx(single.log_density(some), abs=1e-4)
    drawn = index.lookup(*_with_depth(localizer, coarse.sample(400, rng)))
    assert np.isfinite(cell_log_density(coarse, drawn)).all()
    mean = cell_log_density(coarse, drawn).mean()
    error = cell_log_density(coarse, drawn).std() / 20
    assert abs(mean + coarse.entropy_nats) < 4 * error


def _with_depth(localizer, T):
    return T, localizer.space.penetration(T)


@pytest.mark.slow
def test_little_is_lost_where_little_mass_is_left_in_blocks(localizer, rng):
    """Mean log density at true poses, against that of a full pass."""
    lost = []
    for _ in range(30):
        mask, T = some_mask(localizer, rng)
        full, partly = (
            posterior_of(localizer, localizer.scorer.rows(localizer.index, mask, r)) for r in ("all", "cells")
        )
        lost.append(full.log_density(T) - partly.log_density(T))
    assert abs(np.mean(lost)) < 0.1


def test_a_posterior_on_runs_survives_the_disk(localizer, rng, tmp_path, cache_dir):
    mask, T = some_mask(localizer, rng)
    posterior = localizer.localize(mask, kind="mask", effort="fast")
    posterior.save(tmp_path / "p.npz")
    again = Posterior.load(tmp_path / "p.npz", cache_dir)
    assert (again.cells == posterior.cells).all() and (again.runs == posterior.runs).all()
    assert again.log_density(T) == pytest.approx(posterior.log_density(T), abs=1e-4)
