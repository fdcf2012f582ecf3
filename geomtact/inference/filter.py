"""The thesis's Bayes filter over the cells of a contact pose space (8.1): carry on what was known, then weigh a frame in.

    P(G_t | LS_1 .. LS_t)  is proportional to  P(LS_t | G_t) sum over G_t-1 of P(G_t | G_t-1) P(G_t-1 | LS_1 .. LS_t-1)
                                               update          predict

A frame's own posterior, relative to the uniform distribution, is its likelihood up to a constant. Two things are done otherwise
than in the thesis. What one frame says wrongly of a cell the next one says again while the object is in that cell, so frames are
no independent witnesses: what is remembered is a weighted product of all frames whose weights have a fixed sum, and a frame takes
the place of those before it by how far the contact has changed. And a share of the uniform distribution is mixed in before each
frame, so that what a slip made of the pose enters with the next one.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import spelled_out
from geomtact.inference.motion_kernel import Mixture, MotionKernel
from geomtact.inference.posterior import Posterior
from geomtact.se3 import Array, inverse
from geomtact.sensing.moments import moments_of
from geomtact.sensing.reading import Observation

# chosen on trajectories that ``tools.studies track`` does not judge (docs/tracking.md)
NOW = 0.85  # power of a frame's likelihood in its own posterior
MEMORY = 0.6  # power that the likelihoods of all frames before have together
NEWEST = 0.15  # share of it that the newest of them has, at most
FRESH = 0.01
_ANEW = 0.5  # share of the uniform distribution after a slip, or after contact was lost
_SLIP = -2.0  # nats by which what was known may make a frame less likely than chance does
_WIDENED = 4  # frames without contact, at most, for which the object is taken to have moved on
_TAIL = 1e-3  # density relative to the uniform distribution below which cells are not told apart
_AT_HAND = 1 << 15
_IMAGES = 1_000  # of the last frames, by which a prior made from one of them is found out
_BELIEVED = 2_000  # cells of a posterior that stand for it when the next frame is held against it

Counts = tuple[float, float | None]
Known = tuple[NDArray[np.int64], NDArray[np.floating]]  # cells, ascending, and the log probability of each


def has_slipped(surprise: float | None) -> bool:
    """Whether a ``surprise`` [nats], None where there was nothing to compare with, is so low that the object may have slipped."""
    return surprise is not None and surprise < _SLIP


@dataclass
class Filter:
    """What is known between two frames.

    Attributes
    ----------
    motion_kernel : what the object's motion makes of a distribution
    within : (6, 6) covariance of the difference between a contact's moments and those stored for its cell
    counts : powers of a frame's likelihood in its own posterior and in those of all later frames; None for the latter lets all
        frames before count ``MEMORY`` together, each new one taking the place of the older ones by how far the contact changed
    fresh : share of the uniform distribution that is mixed in before a frame; with 0, what is not kept is lost for good
    most : cells that are kept at most
    memory : what is expected of the next frame, as long as the object does not move
    believed : the leading cells of the last posterior; None before the first frame
    T_frame_sensor : (4, 4) of the last frame
    missed : frames without contact since the last frame that had one
    frames : how many there were
    """

    motion_kernel: MotionKernel
    within: Array
    counts: Counts = (NOW, None)
    fresh: float = FRESH
    most: int | None = None
    memory: Mixture = field(default_factory=Mixture)
    believed: Mixture | None = None
    T_frame_sensor: Array | None = None
    missed: int = 0
    frames: int = 0

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.motion_kernel.seed)
        self._last: Posterior | None = None
        self._images: tuple[str, ...] = ()
        self._moments: NDArray[np.float32] | None = None

    def step(self, seen: Posterior) -> Posterior:
        """What is known after one more frame.

        Parameters
        ----------
        seen : the frame's own posterior under the uniform prior; or one whose diagnostics say that the frame was skipped
        """
        began, last, surprise, warnings = perf_counter(), self._last, None, list(seen.warnings)
        known: Known | None = None
        self.frames += 1
        if seen.contact and last is not None and np.array_equal(_observation(seen).image, _observation(last).image):
            warnings.append(f"frame {self.frames} is the same image as the one before: it counts once")
            rests = np.array_equal(last.T_frame_sensor, seen.T_frame_sensor)
            known = (last.cells, last.log_prob) if rests else self._passed_over(seen.T_frame_sensor)
        elif seen.contact:
            if self.missed and self.believed is not None:
                lost = "a frame" if self.missed == 1 else f"{self.missed} frames"
                warnings.append(f"contact was lost for {lost}: of what was known before, half is given up")
            self.predict(seen.T_frame_sensor)
            known, surprise = self.update(seen)
            if has_slipped(surprise):
                chance = f"{np.exp(min(-surprise, 99)):.3g} times less likely than chance does"
                given_up = ": half of it is given up" if self.fresh > 0 else ""
                warnings.append(f"slip? what was known before makes this frame {chance}{given_up}")
        elif seen.diagnostics.is_skipped and not self.missed:
            known = self._passed_over(seen.T_frame_sensor)
        else:
            self.missed += 1
        timing = seen.timing_ms | {"filter": 1e3 * (perf_counter() - began)}
        self._images = tuple(dict.fromkeys([*seen.provenance.images, *self._images]))[:_IMAGES]
        out = replace(
            seen,
            provenance=replace(seen.provenance, earlier_images=self._images),
            diagnostics=replace(seen.diagnostics, frame=self.frames, surprise_nats=surprise),
            timing_ms=timing,
            warnings=warnings,
        )
        if known is not None:
            out = replace(out, cells=known[0], log_prob=known[1], runs=None, contact=True)
        self._last = out if out.contact and not out.diagnostics.is_skipped else None
        return out

    def predict(self, T_frame_sensor: Array) -> None:
        """Let a frame's time pass, and the sensor move to ``T_frame_sensor`` (4, 4)."""
        if self.T_frame_sensor is not None:
            moved = inverse(T_frame_sensor) @ self.T_frame_sensor
            left = None if np.allclose(moved, np.eye(4), atol=1e-9) else self.motion_kernel.left(moved)

            def later(known: Mixture) -> Mixture:
                if left is not None and len(known.cells):
                    known = self.motion_kernel.carried(known, moved, left, self._rng)
                for _ in range(1 + min(self.missed, _WIDENED)):
                    known = self.motion_kernel(known)
                return known.normalised()

            self.memory = later(self.memory).with_uniform(max(self.fresh, _ANEW) if self.missed else self.fresh)
            self.believed = self.believed and later(self.believed)
        self.T_frame_sensor, self.missed = T_frame_sensor, 0

    def update(self, seen: Posterior) -> tuple[Known, float]:
        """What is known after a frame of which ``seen`` is the own posterior, and the surprise [nats]: log of how likely the last
        posterior makes the frame, relative to chance."""
        gain, now, (past, kept) = _gain(seen), 1.0, self._weights(seen)
        expected, surprise = self.memory, 0.0
        if self.believed is not None:
            now = self.counts[0]
            likely = np.exp(gain[self._row(self.believed.cells)])
            with np.errstate(divide="ignore"):
                surprise = float(np.log(self.believed.mass @ likely + self.believed.uniform))
            if has_slipped(surprise) and self.fresh > 0:
                expected = expected.with_uniform(_ANEW)
        before = self._log_density(expected)
        log_density = np.float32(now) * gain
        log_density += before
        log_prob = self._normalise(log_density)
        self.believed = self._kept(log_density, _BELIEVED)
        if (past, kept) != (now, 1.0):
            log_density = np.multiply(gain, np.float32(past), out=gain)
            log_density += np.multiply(before, np.float32(kept), out=before)
            self._normalise(log_density)
        self.memory = self._kept(log_density, self.most)
        return self._known(log_prob), surprise

    def _passed_over(self, T_frame_sensor: Array) -> Known:
        """What is known after a frame that tells nothing."""
        self.predict(T_frame_sensor)
        return self._known(self._normalise(self._log_density(self.memory)))

    def _weights(self, seen: Posterior) -> tuple[float, float]:
        """Powers that a frame's likelihood and what was known before have in what is remembered."""
        mask, before = _observation(seen).contact.mask, self._moments
        self._moments = moments_of(mask, seen.sensor)
        if self.counts[1] is not None:
            return self.counts[1], 1.0
        if before is None:
            return MEMORY, 1.0
        change = self._moments - before
        # mean square, over the moments, in units of that of two contacts within a cell
        new = float(change @ np.linalg.solve(2 * self.within, change)) / len(change)
        new = min(NEWEST, new / 2)
        return MEMORY * new, 1 - new

    def _log_density(self, expected: Mixture) -> NDArray[np.float32]:
        """Log density (n,) relative to the uniform distribution, in all possible cells."""
        density = np.full(len(self._weight), expected.uniform, np.float32)
        rows = self._row(expected.cells)
        density[rows] += expected.mass / self._weight[rows]
        with np.errstate(divide="ignore"):
            return np.log(density, out=density)

    def _normalise(self, log_density: NDArray[np.float32]) -> NDArray[np.float32]:
        """The log probability (n,) of all possible cells, of a log density (n,), which is normalised in place."""
        log_prob = log_density + self.motion_kernel.index.log_possible_weight
        # so many at a time as a processor keeps at hand
        total = sum(float(np.exp(log_prob[i : i + _AT_HAND]).sum()) for i in range(0, len(log_prob), _AT_HAND))
        log_total = np.float32(np.log(total))
        log_density -= log_total
        log_prob -= log_total
        return log_prob

    def _kept(self, log_density: NDArray[np.float32], most: int | None) -> Mixture:
        """The ``most`` densest of the possible cells, of ``log_density`` (n,); the rest, and the negligible, made uniform."""
        bar = np.log(_TAIL)
        if most is not None and most < len(log_density):
            # the densest of every fiftieth tell about where to cut
            some = log_density[::50]
            n = min(most // 40 + 10, len(some))
            bar = max(bar, np.sort(some)[-n])  # sorts faster than it parts, for ties
        kept = np.flatnonzero(log_density >= bar)
        if most is not None and len(kept) > most:
            kept = kept[_largest(log_density[kept], most)]
        cells = self.motion_kernel.index.possible[kept]
        density, weight = np.exp(log_density[kept]), self._weight[kept]
        rest = 0.0
        if self.fresh > 0 and len(kept) < len(log_density):
            rest = max(1 - float(density @ weight), 0) / max(1 - float(weight.sum()), _TAIL)
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

    def _known(self, log_prob: NDArray[np.float32]) -> Known:
        """The possible cells that have mass, by their log probability (n,)."""
        possible, held = self.motion_kernel.index.possible, log_prob > -np.inf
        return (possible, log_prob) if held.all() else (possible[held], log_prob[held])


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
    index = seen.index
    if seen.runs is None:
        return np.asarray(seen.log_prob - index.log_possible_weight, np.float32)
    density = (seen.log_prob - np.log(index.mass(seen.cells, seen.runs))).astype(np.float32)
    out = np.zeros(len(index), np.float32)
    out[spelled_out(seen.cells, seen.runs)] = np.repeat(density, seen.runs)
    return out[index.possible]
