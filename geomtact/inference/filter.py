"""The thesis's Bayes filter over the cells of a contact pose space (8.1): predict, then update by a frame.

    P(G_t | LS_1 .. LS_t)  is proportional to  P(LS_t | G_t) sum over G_t-1 of P(G_t | G_t-1) P(G_t-1 | LS_1 .. LS_t-1)
                                               update          predict

A frame's own posterior, relative to the uniform distribution, is its likelihood up to a constant. The filter departs from the
thesis twice. First, frames do not err independently: an error of one frame in a cell repeats while the object is in that cell.
So the filter keeps a weighted product of all frames whose weights have a fixed sum. A new frame replaces the older ones in
proportion to how far the contact has changed. Second, a share of the uniform distribution is mixed in before each frame, so
that the filter recovers from a slip.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.inference.motion_kernel import Mixture, MotionKernel
from geomtact.inference.posterior import Posterior
from geomtact.log_mass import normalised
from geomtact.se3 import Array, inverse
from geomtact.sensing.moments import moments_of
from geomtact.sensing.reading import Observation

# The next four were chosen on 91 trajectories of four objects, apart from those of the study (docs/evaluation-tracking.md).
FRAME_POWER = 0.85  # power of a frame's likelihood in its own posterior
MEMORY_POWER = 0.6  # summed power of the likelihoods of all earlier frames
NEWEST_SHARE = 0.15  # largest share of ``MEMORY_POWER`` that the newest earlier frame has
UNIFORM_SHARE = 0.01  # share of the uniform distribution that is mixed in before each frame
_UNIFORM_AFTER_LOSS = 0.5  # share of the uniform distribution after a slip or a lost contact; hand-set
_SLIP_NATS = -2.0  # log likelihood of a frame, relative to chance, below which a slip is reported; hand-set
_MOST_MISSED = 4  # largest number of frames without contact for which motion is added; hand-set
_NEGLIGIBLE_DENSITY = 1e-3  # density relative to the uniform below which cells are made uniform; hand-set
_CHUNK = 1 << 15  # cells added up at a time: they fit a processor's cache
_MOST_IMAGES = 1_000  # digests of the last frames that are kept, to detect a prior made from one of them
_LEADING_CELLS = 2_000  # densest cells of a posterior that the next frame is compared with; hand-set

Counts = tuple[float, float | None]
Resolve = Callable[[Posterior, Any, NDArray[np.floating] | None, Posterior], Posterior]
CellLogProb = tuple[NDArray[np.int64], NDArray[np.floating]]  # cells, ascending, and the log probability of each


def has_slipped(surprise: float | None) -> bool:
    """Whether the object may have slipped, by the ``surprise`` [nats] of a frame; None where nothing was compared."""
    return surprise is not None and surprise < _SLIP_NATS


@dataclass
class Filter:
    """The state of the filter between two frames.

    Attributes
    ----------
    motion_kernel : what the object's motion makes of a distribution
    within : (6, 6) covariance of the difference between a contact's moments and those stored for its cell
    counts : powers of a frame's likelihood over the cells, in its own posterior and in those of all later frames. With None for
        the latter, all earlier frames have ``MEMORY_POWER`` together; a new one replaces them by how far the contact changed
    fresh : share of the uniform distribution that is mixed in before a frame; with 0, dropped cells stay impossible
    most : largest number of cells that are kept
    resolve : the posterior within the cells, from that over the cells, the prior that was given for this frame, the log mass (N,)
        that each cell was expected to have, None where nothing was, and the frame's own posterior; None leaves the cells as they
        are
    prior : that was given for the next frame, whose mass the memory has
    memory : the distribution that is predicted for the next frame, while the object does not move
    leading : the leading cells of the last posterior; None before the first frame
    T_frame_sensor : (4, 4) of the last frame
    missed : frames without contact since the last frame that had one
    frames : how many there were
    """

    motion_kernel: MotionKernel
    within: Array
    counts: Counts = (FRAME_POWER, None)
    fresh: float = UNIFORM_SHARE
    most: int | None = None
    resolve: Resolve | None = None
    prior: Any = None
    memory: Mixture = field(default_factory=Mixture)
    leading: Mixture | None = None
    T_frame_sensor: Array | None = None
    missed: int = 0
    frames: int = 0

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.motion_kernel.seed)
        self._last: Posterior | None = None
        self._images: tuple[str, ...] = ()
        self._moments: NDArray[np.float32] | None = None

    def step(self, seen: Posterior) -> Posterior:
        """The posterior after one more frame.

        Parameters
        ----------
        seen : the frame's own posterior under the uniform prior; or one whose diagnostics say that the frame was skipped
        """
        began, last, surprise, warnings = perf_counter(), self._last, None, list(seen.warnings)
        result: CellLogProb | None = None
        log_mass: NDArray[np.floating] | None = None
        self.frames += 1
        repeated = last if seen.contact and last and _shows_the_same(seen, last) else None
        rests = repeated is not None and np.array_equal(repeated.T_frame_sensor, seen.T_frame_sensor)
        if repeated is not None:
            warnings.append(f"frame {self.frames} is the same image as the one before: it counts once")
            result = (repeated.cells, repeated.cell_log_prob) if rests else self._passed_over(seen.T_frame_sensor)
        elif seen.contact:
            if self.missed and self.leading is not None:
                lost = "a frame" if self.missed == 1 else f"{self.missed} frames"
                warnings.append(f"contact was lost for {lost}: half of the earlier distribution is discarded")
            self.predict(seen.T_frame_sensor)
            result, surprise, log_mass = self.update(seen)
            if has_slipped(surprise):
                ratio = f"{np.exp(min(-surprise, 99)):.3g}"
                discarded = ": half of the earlier distribution is discarded" if self.fresh > 0 else ""
                warnings.append(
                    f"possible slip: this frame is {ratio} times less likely under the earlier frames than by chance{discarded}"
                )
        elif seen.diagnostics.is_skipped and not self.missed:
            result = self._passed_over(seen.T_frame_sensor)
        else:
            self.missed += 1
        timing = seen.timing_ms | {"filter": 1e3 * (perf_counter() - began)}
        self._images = tuple(dict.fromkeys([*seen.provenance.images, *self._images]))[:_MOST_IMAGES]
        out = replace(
            seen,
            provenance=replace(seen.provenance, earlier_images=self._images),
            diagnostics=replace(seen.diagnostics, frame=self.frames, surprise_nats=surprise),
            timing_ms=timing,
            warnings=warnings,
        )
        if result is not None:
            out = replace(out, cells=result[0], cell_log_prob=result[1], contact=True)
        if rests and repeated is not None:
            found = replace(out.diagnostics, settled_power=repeated.diagnostics.settled_power)
            out = replace(out, explored=repeated.explored, refined=repeated.refined, diagnostics=found)
        elif self.resolve is not None and seen.contact and repeated is None:
            out = self.resolve(out, self.prior, log_mass, seen)
            self.prior = None
        self._last = out if out.contact and not out.diagnostics.is_skipped else None
        return out

    def predict(self, T_frame_sensor: Array) -> None:
        """Let a frame's time pass, and the sensor move to ``T_frame_sensor`` (4, 4)."""
        if self.T_frame_sensor is not None:
            moved = inverse(T_frame_sensor) @ self.T_frame_sensor
            left = None if np.allclose(moved, np.eye(4), atol=1e-9) else self.motion_kernel.left(moved)

            def later(before: Mixture) -> Mixture:
                if left is not None and len(before.cells):
                    before = self.motion_kernel.carried(before, moved, left, self._rng)
                for _ in range(1 + min(self.missed, _MOST_MISSED)):
                    before = self.motion_kernel(before)
                return before.normalised()

            self.memory = later(self.memory).with_uniform(
                max(self.fresh, _UNIFORM_AFTER_LOSS) if self.missed else self.fresh
            )
            self.leading = self.leading and later(self.leading)
        self.T_frame_sensor, self.missed = T_frame_sensor, 0

    def update(self, seen: Posterior) -> tuple[CellLogProb, float, NDArray[np.floating] | None]:
        """The distribution after a frame with the own posterior ``seen``, the frame's surprise [nats], and the log mass (N,) that
        each cell was expected to have, None where nothing was or it is not asked for.

        The surprise is the log of how likely the last posterior makes the frame, relative to chance.
        """
        gain, now, (past, kept) = _gain(seen), 1.0, self._weights(seen)
        expected, surprise = self.memory, 0.0
        if self.leading is not None:
            now = self.counts[0]
            likely = np.exp(gain[self._row(self.leading.cells)])
            with np.errstate(divide="ignore"):
                surprise = float(np.log(self.leading.mass @ likely + self.leading.uniform))
            if has_slipped(surprise) and self.fresh > 0:
                expected = expected.with_uniform(_UNIFORM_AFTER_LOSS)
        before = self._log_density(expected)
        log_mass = self._log_mass(before) if self.resolve is not None and len(expected.cells) else None
        log_density = np.float32(now) * gain
        log_density += before
        log_prob = self._normalise(log_density)
        self.leading = self._kept(log_density, _LEADING_CELLS)
        if (past, kept) != (now, 1.0):
            log_density = np.multiply(gain, np.float32(past), out=gain)
            log_density += np.multiply(before, np.float32(kept), out=before)
            self._normalise(log_density)
        self.memory = self._kept(log_density, self.most)
        return self._with_mass(log_prob), surprise, log_mass

    def _passed_over(self, T_frame_sensor: Array) -> CellLogProb:
        """The distribution after a frame that constrains nothing."""
        self.prior = None  # the object has moved since
        self.predict(T_frame_sensor)
        return self._with_mass(self._normalise(self._log_density(self.memory)))

    def _weights(self, seen: Posterior) -> tuple[float, float]:
        """Powers of a frame's likelihood and of the earlier distribution in the memory."""
        mask, before = _observation(seen).contact.mask, self._moments
        self._moments = moments_of(mask, seen.sensor)
        if self.counts[1] is not None:
            return self.counts[1], 1.0
        if before is None:
            return MEMORY_POWER, 1.0
        change = self._moments - before
        # mean square, over the moments, in units of that of two contacts within a cell
        new = float(change @ np.linalg.solve(2 * self.within, change)) / len(change)
        new = min(NEWEST_SHARE, new / 2)
        return MEMORY_POWER * new, 1 - new

    def _log_density(self, expected: Mixture) -> NDArray[np.float32]:
        """Log density (n,) relative to the uniform distribution, in all possible cells."""
        density = np.full(len(self._weight), expected.uniform, np.float32)
        rows = self._row(expected.cells)
        density[rows] += expected.mass / self._weight[rows]
        with np.errstate(divide="ignore"):
            return np.log(density, out=density)

    def _log_mass(self, log_density: NDArray[np.float32]) -> NDArray[np.float32]:
        """The log mass (N,) of every cell, of a log density (n,) in all possible cells."""
        index = self.motion_kernel.index
        out = np.full(len(index), -np.inf, np.float32)
        out[index.possible] = log_density + index.log_possible_weight
        return normalised(out)

    def _normalise(self, log_density: NDArray[np.float32]) -> NDArray[np.float32]:
        """The log probability (n,) of all possible cells, of a log density (n,), which is normalised in place."""
        log_prob = log_density + self.motion_kernel.index.log_possible_weight
        # in chunks that fit a processor's cache
        total = sum(float(np.exp(log_prob[i : i + _CHUNK]).sum()) for i in range(0, len(log_prob), _CHUNK))
        log_total = np.float32(np.log(total))
        log_density -= log_total
        log_prob -= log_total
        return log_prob

    def _kept(self, log_density: NDArray[np.float32], most: int | None) -> Mixture:
        """The ``most`` densest of the possible cells, of ``log_density`` (n,); all other cells are made uniform."""
        bar = np.log(_NEGLIGIBLE_DENSITY)
        if most is not None and most < len(log_density):
            # the densest of every fiftieth give a first threshold
            some = log_density[::50]
            n = min(most // 40 + 10, len(some))
            bar = max(bar, np.sort(some)[-n])  # sorting is faster than partitioning where many tie
        kept = np.flatnonzero(log_density >= bar)
        if most is not None and len(kept) > most:
            kept = kept[_largest(log_density[kept], most)]
        cells = self.motion_kernel.index.possible[kept]
        density, weight = np.exp(log_density[kept]), self._weight[kept]
        rest = 0.0
        if self.fresh > 0 and len(kept) < len(log_density):
            rest = max(1 - float(density @ weight), 0) / max(1 - float(weight.sum()), _NEGLIGIBLE_DENSITY)
        return Mixture(cells, np.maximum(density - rest, 0) * weight, rest).normalised()

    def _row(self, cells: NDArray[np.int64]) -> NDArray[np.int64] | slice:
        """Which of the possible cells each of ``cells`` (n,) is."""
        possible = self.motion_kernel.index.possible
        return slice(None) if len(cells) == len(possible) else np.searchsorted(possible, cells)

    @cached_property
    def _weight(self) -> NDArray[np.float32]:
        """Share (n,) of the uniform measure in each of the possible cells."""
        index = self.motion_kernel.index
        return np.asarray(index.weight).ravel()[index.possible]

    def _with_mass(self, log_prob: NDArray[np.float32]) -> CellLogProb:
        """The possible cells that have mass, by their log probability (n,)."""
        possible, held = self.motion_kernel.index.possible, log_prob > -np.inf
        return (possible, log_prob) if held.all() else (possible[held], log_prob[held])


def _shows_the_same(seen: Posterior, last: Posterior) -> bool:
    return np.array_equal(_observation(seen).image, _observation(last).image)


def _observation(seen: Posterior) -> Observation:
    assert seen.observation is not None  # a frame with contact that was not skipped has one
    return seen.observation


def _largest(values: NDArray[np.floating], n: int) -> NDArray[np.bool_]:
    """Which (m,) of ``values`` (m,) are the ``n`` largest, the first of those that tie."""
    least = np.sort(values)[-n]
    out = values > least
    out[np.flatnonzero(values == least)[: n - int(out.sum())]] = True
    return out


def _gain(seen: Posterior) -> NDArray[np.float32]:
    """Log density (n,) of a posterior in all possible cells, relative to the uniform distribution."""
    return np.asarray(seen.cell_log_prob - seen.index.log_possible_weight, np.float32)
