"""A sequence of frames: the thesis's Bayes filter over the discretised contact pose space (8.1).

    P(G_t | LS_1 .. LS_t)  is proportional to  P(LS_t | G_t) sum over G_t-1 of P(G_t | G_t-1) P(G_t-1 | LS_1 .. LS_t-1)

A frame's own posterior, relative to the uniform distribution, is its likelihood up to a constant. Two things are done otherwise
than in the thesis. What one frame says wrongly of a cell the next one says again while the object is in that cell, so frames are
no independent witnesses: for the frames after it a frame counts by how far the contact has changed since the one before. And a
share of the uniform distribution is mixed in before each frame, so that what a slip made of the pose enters with the next one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sized
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import repeat
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags, identity
from scipy.spatial.transform import Rotation

from geomtact.contact_space.carry import Carry
from geomtact.contact_space.index import Index, spelled_out
from geomtact.errors import InputError, UsageError, nearest_name
from geomtact.geometry.approach import allowed, approach_of, facing, in_cones
from geomtact.geometry.mesh import Mesh
from geomtact.inference.posterior import Posterior
from geomtact.inference.prior import prior_log_mass
from geomtact.se3 import Array, check_transforms, exp, inverse, transform
from geomtact.sensing.moments import moments, without_specks

if TYPE_CHECKING:
    from geomtact.inference.localizer import Localizer

# measured on trajectories of three parts (evaluation/trajectories.py): best in the mean, and hardly ever below single frames
NOW = 0.9  # power of a frame's likelihood in its own posterior
_MOST_PAST = 0.5  # in those of later frames, at most
FRESH = 0.01
_ANEW = 0.5  # share of the uniform distribution after a slip, or after contact was lost
_SLIP = -2.0  # nats by which what was known may make a frame less likely than chance does
_WIDENED = 4  # frames without contact, at most, for which the object is taken to have moved on
_TAIL = 1e-3  # density relative to the uniform distribution below which cells are not told apart
_BELIEVED = 2_000  # cells of a posterior that stand for it when the next frame is held against it
_TWISTS = 4096  # motions drawn, which stand for all
_ROTATIONS = 256, 1 << 13, 1 << 17  # drawn to count how many leave their cell: a cell, at least, and at most
_CARRIED = 150_000, 2, 64  # points that are carried along with the sensor: in all, and of a cell at least and at most
_LEAST_TAP = 1e-4
_MIXED = 0.1  # by how much the shares of the penetrations may differ, relative to their mean, when they count as mixed
_ERRORS = ("raise", "skip")
_NO_POSE = object()
_NO_FRAMES = "frames: expected at least one image, got none; check the folder, or the generator"


@dataclass(frozen=True)
class UniformBall:
    """The thesis's motion: from one frame to the next, anything up to ``radius`` [m] in mean point distance."""

    radius: float = 8e-3

    def twists(self, mesh: Mesh, n: int, rng: np.random.Generator) -> Array:
        """Motions xi (n, 6) about the object's centre, uniform over the ball to first order [rad, m]."""
        points = mesh.surface_points(256) - mesh.centre
        J = np.zeros((len(points), 3, 6))
        J[:, :, 3:] = np.eye(3)
        J[:, :, :3] = np.cross(np.eye(3), points[:, None]).swapaxes(1, 2)
        # a ball in root mean square distance is an ellipsoid; the mean is no larger, and seldom below three quarters of it
        half = np.linalg.inv(np.linalg.cholesky(np.einsum("pia,pib->ab", J, J) / len(points))).T
        found = np.zeros((0, 6))
        while len(found) < n:
            g = rng.normal(size=(n, 6))
            g *= rng.random((n, 1)) ** (1 / 6) / np.linalg.norm(g, axis=1, keepdims=True)
            xi = 1.3 * self.radius * g @ half.T
            distance = np.linalg.norm(np.einsum("pia,na->npi", J, xi), axis=2).mean(1)
            found = np.concatenate([found, xi[distance <= self.radius]])
        return found[:n]


@dataclass(frozen=True)
class GaussianTwist:
    """Normally distributed motion about the object's centre from one frame to the next.

    Attributes
    ----------
    rotation : standard deviation about each axis [rad]
    translation : standard deviation along each axis [m]
    """

    rotation: float
    translation: float

    def twists(self, mesh: Mesh, n: int, rng: np.random.Generator) -> Array:
        """Motions xi (n, 6) about the object's centre [rad, m]."""
        return rng.normal(size=(n, 6)) * np.repeat([self.rotation, self.translation], 3)


Motion = UniformBall | GaussianTwist
Known = tuple[NDArray[np.int64], NDArray[np.floating]]  # cells, ascending, and the log probability of each


@dataclass(frozen=True, eq=False)
class Mixture:
    """A distribution over the cells of an index: ``mass`` (n,) in ``cells`` (n,), and a share ``uniform`` of the uniform one."""

    cells: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    mass: Array = field(default_factory=lambda: np.zeros(0))
    uniform: float = 1.0

    def mixed(self, uniform: float) -> Mixture:
        """The distribution with a share ``uniform`` more of the uniform one."""
        return Mixture(self.cells, (1 - uniform) * self.mass, (1 - uniform) * self.uniform + uniform)

    def normalised(self) -> Mixture:
        """Of total mass 1; uniform where there is none."""
        total = float(self.mass.sum()) + self.uniform
        return Mixture(self.cells, self.mass / total, self.uniform / total) if total > 0 else Mixture()


@dataclass(frozen=True, eq=False)
class Spread:
    """What a motion makes of a distribution over the cells of ``index``.

    Cells are about as wide as the motion, so what counts is the share of a cell that leaves it. Shifts along x and along y,
    changes of penetration, and turns are taken one after the other, each of them reversible: between two cells as much of the
    uniform distribution goes one way as the other. What would leave the contact pose space stays in its cell, because contact
    goes on; were it dropped, a shaft would lose against a plate from frame to frame, whatever is seen. So the uniform
    distribution stays what it is.
    """

    index: Index
    motion: Motion
    seed: int = 0

    def __call__(self, before: Mixture) -> Mixture:
        """The distribution one frame later, over the sensor as it stands."""
        if not len(before.cells):
            return before
        level, place = np.divmod(before.cells, self.index.places)
        rotation, (_, ny, nx, depths) = self.index.rotation[place], self._share.shape
        live, row = _numbered(rotation, len(self._share))
        at = (row[rotation] * (ny * nx) + self._lattice[place]) * depths + level % depths
        grid = np.bincount(at, before.mass, len(live) * ny * nx * depths).astype(np.float32).reshape(-1, ny, nx, depths)
        share, (along_y, along_x, deeper, _) = self._share[live], self._stay
        grid = along_y[live] * grid + share * _shifted(grid, self._taps, 1)
        grid = along_x[live] * grid + share * _shifted(grid, self._taps, 2)
        grid = deeper[live] * grid + share * (grid @ _off_diagonal(self._levels))
        return Mixture(*self._turned(live, grid), before.uniform)

    def _turned(self, live: NDArray[np.int64], grid: NDArray[np.float32]) -> tuple[NDArray[np.int64], Array]:
        """The cells (m,), and the mass (m,) of each, to which ``grid`` (r, ny, nx, D) of rotations ``live`` (r,) is turned."""
        index, leave = self.index, self._leaving[live]
        reached, row = _numbered(np.concatenate([live, leave.indices]), len(self._share))
        flat = grid.reshape(len(live), -1)
        out = leave[:, reached].T.tocsr() @ flat
        out *= self._share[reached].reshape(len(reached), -1)
        out[row[live]] += self._stay[3][live].reshape(flat.shape) * flat
        order, first = self._by_rotation
        places = order[spelled_out(first[reached], np.diff(first)[reached])]
        mass = out.reshape(len(reached), -1, grid.shape[-1])[row[index.rotation[places]], self._lattice[places]].T
        if len(mass) < len(index.height):
            mass = mass * np.take(self._pressed, places, axis=1)
        mass = mass.ravel()
        found = np.flatnonzero(mass)
        cells = np.add.outer(np.arange(len(index.height)) * index.places, places).ravel()
        return cells[found], mass[found]

    def left(self, T_after_before: Array) -> NDArray[np.float32]:
        """Which share (P, n) of every place touches at each penetration after the sensor has moved, the object staying where it is:
        what lay at T lies at ``T_after_before @ T`` (4, 4). It is told relative to a sensor that stands still."""
        share = self._touching(T_after_before)
        total = np.maximum(share.sum(0), 1e-30)
        return np.asarray(share * (np.minimum(1, total / self._standing) / total))

    def carried(
        self, before: Mixture, T_after_before: Array, left: NDArray[np.float32], rng: np.random.Generator
    ) -> Mixture:
        """The distribution over the sensor after it has moved as for :attr:`left`. What does not touch any more is lost.

        A step may be much shorter than a cell, so points drawn anew in every cell are carried: now and then one of them crosses
        over.
        """
        index, (ny, nx), cells = self.index, self.index.table.shape[1:], before.cells
        points, least, most = _CARRIED
        draws = min(max(points // len(cells), least), most)
        level, place = np.divmod(cells, index.places)
        local = np.column_stack([index.shift[place], index.height[level, place]])
        centre = local @ T_after_before[:3, :3].T + T_after_before[:3, 3]
        live, row = np.unique(index.rotation[place], return_inverse=True)
        _, rotation = self._rotation_of(T_after_before[:3, :3] @ self._any_within(np.tile(live, draws), rng))
        rotation = rotation.reshape(draws, -1)[:, row].ravel()
        centre = np.tile(centre[:, :2], (draws, 1))
        x, y = index.lattice(centre + index.resolution.step * rng.uniform(-0.5, 0.5, centre.shape))
        there = index.table[rotation, np.clip(y, 0, ny - 1), np.clip(x, 0, nx - 1)]
        # the table names a neighbour where a cell does not touch
        mass = before.mass / draws * left[:, place]
        own = np.flatnonzero(
            (self._lattice[there] == y * nx + x) & (index.rotation[there] == rotation) & (x >= 0) & (x < nx)
        )
        out = np.array([np.bincount(there[own], each[own % len(cells)], index.places) for each in mass])
        out[np.asarray(index.weight) == 0] = 0
        found = np.flatnonzero(out)
        return Mixture(found, out.reshape(-1)[found], before.uniform)

    def _touching(self, T_after_before: Array) -> NDArray[np.float32]:
        return Carry(self.index, self.index, T_after_before).shares(np.arange(self.index.places))[1]

    @cached_property
    def _standing(self) -> NDArray[np.float32]:
        """Which share (n,) of every place touches by :class:`Carry` where nothing moves."""
        return np.maximum(self._touching(np.eye(4)).sum(0), 1e-30)

    @cached_property
    def _lattice(self) -> NDArray[np.int64]:
        """Flat lattice cell (n,) of every place."""
        x, y = self.index.lattice(self.index.shift.astype(float))
        return y * self.index.table.shape[2] + x

    @cached_property
    def _by_rotation(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """All places (n,), rotation by rotation, and the first (M + 1,) of each rotation in that list."""
        count = np.bincount(self.index.rotation, minlength=len(self._measure))
        return np.argsort(self.index.rotation, kind="stable"), np.concatenate([[0], np.cumsum(count)])

    @cached_property
    def _measure(self) -> Array:
        """Haar measure (M,) of every rotation."""
        directions = self.index.directions
        return np.repeat(directions.weights / directions.turns, directions.turns)

    @cached_property
    def _share(self) -> NDArray[np.float32]:
        """Which share of every cell touches (M, ny, nx, D), relative to the cell of which most does.

        D penetrations, or one that stands for all where the motion mixes them.
        """
        index, depths = self.index, len(self._levels)
        ny, nx = index.table.shape[1:]
        out = np.zeros((len(self._measure), ny * nx, depths), np.float32)
        weight = np.asarray(index.weight).reshape(-1, depths, index.places).mean(0)
        out[index.rotation, self._lattice] = (weight / self._measure[index.rotation]).T
        return out.reshape(-1, ny, nx, depths) / out.max()

    @cached_property
    def _pressed(self) -> NDArray[np.float32]:
        """Which share (P, n) of the measure of every place lies at each penetration."""
        weight = np.asarray(self.index.weight)
        return weight / weight.sum(0)

    @cached_property
    def _stay(self) -> list[NDArray[np.float32]]:
        """Share of every cell (M, ny, nx, D) that stays when cells are shifted along y, along x, pressed deeper, or turned."""
        share = self._share
        turned = (self._leaving @ share.reshape(len(share), -1)).reshape(share.shape)
        deeper = share @ _off_diagonal(self._levels)
        leaves = (_shifted(share, self._taps, 1), _shifted(share, self._taps, 2), deeper, turned)
        return [np.maximum(1 - each, 0) for each in leaves]

    @cached_property
    def _twists(self) -> Array:
        return self.motion.twists(self.index.mesh, _TWISTS, np.random.default_rng(self.seed))

    @cached_property
    def _taps(self) -> NDArray[np.float32]:
        """Share (k + 1,) of a lattice cell that is shifted by 0 .. k cells, to either side, along x or y."""
        step = np.abs(self._twists[:, 3:].ravel()) / self.index.resolution.step
        taps = np.array([np.maximum(1 - np.abs(step - i), 0).mean() for i in range(int(step.max()) + 2)])
        taps[1:] /= 2
        taps = taps[: 1 + int(np.flatnonzero(taps > _LEAST_TAP)[-1])]
        return np.asarray(taps / (taps[0] + 2 * taps[1:].sum()), np.float32)

    @cached_property
    def _levels(self) -> NDArray[np.float32]:
        """Share (D, D) of a bin of penetration that goes to another one, reflected at the least and the largest."""
        bins = len(self.index.height)
        step = self._twists[:, 3:].ravel() / (self.index.sensor.max_penetration / bins)
        start = (np.arange(16 * bins) + 0.5) / 16
        depth = bins - np.abs(bins - (start[:, None] + step) % (2 * bins))
        moved = np.minimum(depth.astype(np.int64), bins - 1) + bins * start.astype(np.int64)[:, None]
        share = np.bincount(moved.ravel(), minlength=bins**2).reshape(bins, bins) / (16 * len(step))
        share = 0.5 * (share + share.T)
        if np.abs(share * bins - 1).max() < _MIXED:
            return np.ones((1, 1), np.float32)
        np.fill_diagonal(share, share.diagonal() + 1 - share.sum(1))
        return share.astype(np.float32)

    @cached_property
    def _turns(self) -> csr_matrix:
        """Share (M, M) of each rotation's cell that is turned into another's."""
        directions, rng, n = self.index.directions, np.random.default_rng(self.seed), len(self._measure)
        R, start = self._drawn
        turn = self._twists[rng.integers(_TWISTS, size=len(R)), :3]
        if directions.level is None:  # an exact face stays one
            face = approach_of(R)
            turn = (turn * face).sum(1, keepdims=True) * face
        T, end = self._rotation_of(R @ exp(np.pad(turn, ((0, 0), (0, 3))))[:, :3, :3])
        end = np.where(allowed(approach_of(T[:, :3, :3]), directions.cones), end, start)
        goes = csr_matrix((np.ones(len(end)), (start, end)), (n, n)) + 1e-9 * identity(n)
        flux = 0.5 * (goes + goes.T)
        for _ in range(20):  # takes off the sampling errors: a cell's measure is shared out, no more and no less
            scale = diags(np.sqrt(self._measure / np.asarray(flux.sum(1)).ravel()))
            flux = scale @ flux @ scale
        return (diags(1 / self._measure) @ flux).tocsr().astype(np.float32)

    @cached_property
    def _leaving(self) -> csr_matrix:
        """:attr:`_turns` without what stays."""
        out = self._turns.copy()
        out.setdiag(0)
        out.eliminate_zeros()
        return out

    @cached_property
    def _drawn(self) -> tuple[Array, NDArray[np.int64]]:
        """Rotations (n, 3, 3) drawn uniformly over those allowed, and the one (n,) of the grid, ascending, that holds each."""
        each, least, largest = _ROTATIONS
        rng, n = np.random.default_rng(self.seed), min(max(each * len(self._measure), least), largest)
        a = in_cones(self.index.directions.cones or [(np.array([0.0, 0.0, 1.0]), np.pi)], n, rng)
        Rz = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi, (n, 1))).as_matrix()
        T, cell = self._rotation_of(Rz @ facing(a))
        order = np.argsort(cell, kind="stable")
        return T[order, :3, :3], cell[order]

    def _any_within(self, rotations: NDArray[np.integer], rng: np.random.Generator) -> Array:
        """One rotation (m, 3, 3) drawn within the cell of each of ``rotations`` (m,)."""
        R, cell = self._drawn
        first, end = np.searchsorted(cell, rotations), np.searchsorted(cell, rotations, "right")
        drawn = R[np.minimum(first + (rng.random(len(first)) * (end - first)).astype(np.int64), len(R) - 1)]
        return np.where((end > first)[:, None, None], drawn, self.index.rotations[rotations])

    def _rotation_of(self, R: Array) -> tuple[Array, NDArray[np.int64]]:
        """The canonical images (n, 4, 4) of rotations ``R`` (n, 3, 3), and the rotation (n,) of the grid that holds each."""
        T, direction, turn = self.index.directions.lookup(transform(R, np.zeros(3)))
        return T, self.index.directions.first_turn[direction] + turn


@dataclass
class Filter:
    """What is known between two frames. Frames without contact are told by ``missed``.

    Attributes
    ----------
    spread : what the object's motion makes of a distribution
    now : power of a frame's likelihood in its own posterior
    fresh : share of the uniform distribution that is mixed in before a frame; with 0, what is not kept is lost for good
    most : cells that are kept at most
    memory : what is expected of the next frame, as long as the object does not move
    believed : the leading cells of the last posterior; None before the first frame
    T_frame_sensor : (4, 4) of the last frame
    missed : frames without contact since the last frame that had one
    """

    spread: Spread
    now: float = NOW
    fresh: float = FRESH
    most: int | None = None
    memory: Mixture = field(default_factory=Mixture)
    believed: Mixture | None = None
    T_frame_sensor: Array | None = None
    missed: int = 0

    def advance(self, T_frame_sensor: Array, rng: np.random.Generator) -> None:
        """Let a frame's time pass, and the sensor move to ``T_frame_sensor`` (4, 4)."""
        if self.T_frame_sensor is not None:
            moved = inverse(T_frame_sensor) @ self.T_frame_sensor
            left = None if np.allclose(moved, np.eye(4), atol=1e-9) else self.spread.left(moved)

            def later(known: Mixture) -> Mixture:
                if left is not None and len(known.cells):
                    known = self.spread.carried(known, moved, left, rng)
                for _ in range(1 + min(self.missed, _WIDENED)):
                    known = self.spread(known)
                return known.normalised()

            self.memory = later(self.memory).mixed(max(self.fresh, _ANEW) if self.missed else self.fresh)
            self.believed = self.believed and later(self.believed)
        self.T_frame_sensor, self.missed = T_frame_sensor, 0

    def see(self, seen: Posterior, past: float) -> tuple[Known, float]:
        """What is known after a frame, and the surprise [nats]: log of how likely the last posterior makes the frame, relative to
        chance.

        Parameters
        ----------
        seen : the frame's own posterior under the uniform prior
        past : power of its likelihood in the posteriors of later frames
        """
        gain, now, expected, surprise = _gain(seen), 1.0, self.memory, 0.0
        if self.believed is not None:
            now = self.now
            likely = np.exp(gain[self._row(self.believed.cells)])
            with np.errstate(divide="ignore"):
                surprise = float(np.log(self.believed.mass @ likely + self.believed.uniform))
            if surprise < _SLIP and self.fresh > 0:
                expected = expected.mixed(_ANEW)
        before = self._log_expected(expected)
        log_density, log_prob = self._joint(before, np.float32(now) * gain)
        self.believed = self._kept(log_density, _BELIEVED)
        if past != now:
            log_density, _ = self._joint(before, np.float32(past) * gain)
        self.memory = self._kept(log_density, self.most)
        return self._known(log_prob), surprise

    def pass_over(self, T_frame_sensor: Array, rng: np.random.Generator) -> Known:
        """What is known after a frame that cannot be seen."""
        self.advance(T_frame_sensor, rng)
        nothing = np.zeros(len(self.spread.index.possible), np.float32)
        return self._known(self._joint(self._log_expected(self.memory), nothing)[1])

    def _log_expected(self, expected: Mixture) -> tuple[NDArray[np.int64], NDArray[np.float32], np.float32]:
        """Some of the possible cells (m,), the log density (m,) there relative to the uniform distribution, and elsewhere."""
        weight = np.asarray(self.spread.index.weight).reshape(-1)[expected.cells]
        with np.errstate(divide="ignore"):
            own = np.log((expected.uniform + expected.mass / weight).astype(np.float32))
            return self._row(expected.cells), own, np.float32(np.log(expected.uniform))

    def _joint(
        self, before: tuple[NDArray[np.int64], NDArray[np.float32], np.float32], gain: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Log density relative to the uniform distribution and log probability (n,), both normalised, of the n possible cells:
        what was expected, as :meth:`_log_expected` gives it, times exp(``gain``) (n,)."""
        rows, own, elsewhere = before
        density = gain + elsewhere
        density[rows] = gain[rows] + own
        log_prob = density + self.spread.index.log_possible_weight
        log_total = np.log(np.exp(log_prob).sum())
        density -= log_total
        log_prob -= log_total
        return density, log_prob

    def _kept(self, log_density: NDArray[np.float32], most: int | None) -> Mixture:
        """The ``most`` densest of the possible cells, of ``log_density`` (n,); the rest, and the negligible, made uniform."""
        bar = np.log(_TAIL)
        if most is not None and most < len(log_density):
            # the densest of every fiftieth tell about where to cut
            some = log_density[::50]
            n = min(most // 40 + 10, len(some))
            bar = max(bar, np.partition(some, -n)[-n])
        kept = np.flatnonzero(log_density >= bar)
        if most is not None and len(kept) > most:
            kept = np.sort(kept[np.argpartition(log_density[kept], -most)[-most:]])
        cells = self.spread.index.possible[kept]
        density, weight = np.exp(log_density[kept]), np.asarray(self.spread.index.weight).reshape(-1)[cells]
        rest = 0.0
        if self.fresh > 0 and len(kept) < len(log_density):
            rest = max(1 - float(density @ weight), 0) / max(1 - float(weight.sum()), _TAIL)
        return Mixture(cells, np.maximum(density - rest, 0) * weight, rest).normalised()

    def _row(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """Which of the possible cells each of ``cells`` (n,) is."""
        possible = self.spread.index.possible
        return cells if len(possible) == len(self.spread.index) else np.searchsorted(possible, cells)

    def _known(self, log_prob: NDArray[np.float32]) -> Known:
        """The possible cells that have mass, by their log probability (n,)."""
        possible, held = self.spread.index.possible, log_prob > -np.inf
        return (possible, log_prob) if held.all() else (possible[held], log_prob[held])


def track(
    localizer: Localizer,
    frames: Iterable[Any],
    T_world_sensor: Any = None,
    motion: Motion | None = None,
    effort: str = "balanced",
    prior: Any = None,
    most: int | None = None,
    *,
    kind: str = "auto",
    background: Any = None,
    counts: tuple[float, float | None] = (NOW, None),
    fresh: float = FRESH,
    on_error: str = "raise",
    seed: int = 0,
) -> Iterator[Posterior]:
    """The posterior after each frame, given all frames up to it. Each is computed when it is asked for.

    Parameters
    ----------
    frames : images as ``localize`` takes them, a list or a generator, such as a live camera
    T_world_sensor : (4, 4) of a sensor at rest, or one a frame (n, 4, 4), a list or a generator: the posteriors are then in the
        world frame, and where the sensor moves the object is taken to stay, but for ``motion``
    motion : of the object from one frame to the next, ``UniformBall()`` by default; the tighter it is, the more the frames before
        tell
    effort, kind, background, seed : as for ``localize``
    prior : what was known before the first frame (see ``inference.prior``)
    most : cells that are kept from frame to frame at most, which bounds the time a frame takes; all that count by default
    counts : powers of a frame's likelihood, in its own posterior and in those of all later frames; None for the latter takes half
        of d^2, and at most one half, with d how far the contact has changed since the frame before, in units of what contacts
        within a cell differ by. (1, 1) is the thesis's, for frames that err independently, such as separate touches
    fresh : share of the uniform distribution that is mixed in before each frame; 0 is the thesis's filter, which forgets for good
        whatever it does not keep
    on_error : "raise", or "skip" a frame that cannot be read: its posterior is what the frames before expect

    Yields
    ------
    Posterior
        ``settings["surprise_nats"]`` is the log of how likely the posterior before made the frame, relative to chance. Where it
        is far below 0 a warning says that the object may have slipped, and half of what was known before is given up; the same
        is done when contact is back after frames without. A frame without contact has the posterior that ``localize`` gives.

    Raises
    ------
    UsageError, InputError
        Told at once, or with the frame they concern, counted from 1.
    """
    motion = motion or UniformBall()
    _check(frames, localizer.sensor.image_size_px, motion, counts, fresh, most, on_error)
    state = Filter(Spread(localizer.index, motion, seed), counts[0], fresh, most)
    options = {"effort": effort, "kind": kind, "background": background, "seed": seed}
    settings = {"motion": {"kind": type(motion).__name__, **asdict(motion)}, "counts": list(counts), "fresh": fresh}
    pairs = _pairs(frames, _poses(frames, T_world_sensor))
    return _tracked(localizer, pairs, state, counts[1], prior, options, settings, on_error == "skip")


def _tracked(
    localizer: Localizer,
    pairs: Iterable[tuple[int, Any, Array | None]],
    state: Filter,
    past: float | None,
    prior: Any,
    options: dict[str, Any],
    settings: dict[str, Any],
    skip: bool,
) -> Iterator[Posterior]:
    rng = np.random.default_rng(options["seed"])
    index, last, change = localizer.index, None, _Change(localizer.scorer.witness.moments.covariance)
    for n, image, T in pairs:
        frame, at = ("sensor", np.eye(4)) if T is None else ("world", T)
        if n == 1 and prior is not None:
            log_mass = prior_log_mass(index, prior, at, frame, localizer.cache_dir)
            state.memory = Mixture(np.flatnonzero(np.isfinite(log_mass)), np.exp(log_mass[np.isfinite(log_mass)]), 0.0)
        try:
            seen = localizer.localize(image, T_world_sensor=T, **options)
        except InputError as error:
            if not skip:
                raise type(error)(f"frame {n}: {error}") from None
            seen = Posterior(index, np.zeros(0, np.int64), np.zeros(0), frame, at, contact=False, seed=options["seed"])
            seen = replace(seen, warnings=[f"frame {n} was skipped: {error}"])
        known: Known | None = None
        began, surprise, warnings = perf_counter(), None, list(seen.warnings)
        if seen.contact and last is not None and np.array_equal(seen.observation.image, last.observation.image):
            warnings.append(f"frame {n} is the same image as the one before: it counts once")
            rests = np.array_equal(last.T_frame_sensor, at)
            known = (last.cells, last.log_prob) if rests else state.pass_over(at, rng)
        elif seen.contact:
            if state.missed:
                told = f"contact was lost for {state.missed} frames"
                warnings.append(f"{told}: of what was known before, half is given up")
            state.advance(at, rng)
            changed = change.since_last(seen)
            known, surprise = state.see(seen, min(_MOST_PAST, changed / 2) if past is None else past)
            if surprise < _SLIP:
                chance = f"{np.exp(min(-surprise, 99)):.3g} times less likely than chance does"
                warnings.append(f"slip? what was known before makes this frame {chance}: half of it is given up")
        elif not seen.observations and not state.missed:
            known = state.pass_over(at, rng)
        else:
            state.missed += 1
        entries = {"frame": n, "surprise_nats": surprise, **settings}
        timing = seen.timing_ms | {"filter": 1e3 * (perf_counter() - began)}
        seen = replace(seen, settings=seen.settings | entries, timing_ms=timing, warnings=warnings)
        if known is not None:
            seen = replace(seen, cells=known[0], log_prob=known[1], runs=None, contact=True)
        last = seen if seen.observations and seen.contact else None
        yield seen


@dataclass
class _Change:
    """How far a contact has changed since the last one.

    Attributes
    ----------
    covariance : (6, 6) of the difference between the moments of a contact and those stored for its cell
    last : (6,) moments of the last contact
    """

    covariance: Array
    last: NDArray[np.float32] | None = None

    def since_last(self, seen: Posterior) -> float:
        """The mean square, over the moments, in units of that of two contacts within a cell; inf for the first contact."""
        mask, before = seen.observation.contact.mask, self.last
        self.last = moments(without_specks(mask, seen.sensor.pixel_area(mask.shape))[None], seen.sensor)[0]
        if before is None:
            return np.inf
        change = self.last - before
        return float(change @ np.linalg.solve(2 * self.covariance, change)) / len(change)


def _check(
    frames: Any,
    size: tuple[int, int],
    motion: Motion,
    counts: tuple[float, float | None],
    fresh: float,
    most: int | None,
    on_error: str,
) -> None:
    if isinstance(frames, str | Path):
        raise UsageError(f"frames: expected several images, got the path {str(frames)!r}; give a list of paths")
    if isinstance(frames, np.ndarray) and frames.shape[:2] == size[::-1]:
        raise UsageError(f"frames: expected several images, got one of shape {frames.shape}; give it in a list")
    if isinstance(frames, Sized) and len(frames) == 0:
        raise InputError(_NO_FRAMES)
    if not all(0 <= each < np.inf for each in asdict(motion).values()):
        raise UsageError(f"motion: expected finite lengths [m] and angles [rad], not below 0, got {motion}")
    if len(counts) != 2 or not 0 < counts[0] <= 1 or not (counts[1] is None or 0 <= counts[1] <= 1):
        raise UsageError(f"counts: expected two powers, above 0 to 1 and 0 to 1 or None, got {counts}")
    if not 0 <= fresh < 1:
        raise UsageError(f"fresh: expected a share from 0 to below 1, got {fresh}")
    if most is not None and most < 1:
        raise UsageError(f"most: expected at least one cell, or None for all that count, got {most}")
    if on_error not in _ERRORS:
        raise UsageError(f"on_error: nothing named {on_error!r}{nearest_name(on_error, _ERRORS)}")


def _poses(frames: Iterable[Any], T_world_sensor: Any) -> Array | Iterator[Any] | None:
    """The sensor's poses: (4, 4) for one at rest, (n, 4, 4), or an iterator; None where none are given."""
    if T_world_sensor is None or isinstance(T_world_sensor, Iterator):
        return T_world_sensor
    poses = check_transforms(T_world_sensor, "T_world_sensor")
    if poses.ndim > 3:
        raise InputError(f"T_world_sensor: expected (4, 4), or (n, 4, 4) for n frames, got shape {poses.shape}")
    if poses.ndim == 3 and isinstance(frames, Sized) and len(frames) != len(poses):
        raise _number_error(len(frames), len(poses))
    return poses


def _pairs(frames: Iterable[Any], poses: Array | Iterator[Any] | None) -> Iterator[tuple[int, Any, Array | None]]:
    """Number, image and pose of the sensor (4, 4), if any, of each frame."""
    at_rest = poses is None or (isinstance(poses, np.ndarray) and poses.ndim == 2)
    each: Iterator[Any] = repeat(poses) if at_rest else iter(poses)  # type: ignore[arg-type]
    n = 0
    for n, image in enumerate(frames, 1):
        T: Any = next(each, _NO_POSE)
        if T is _NO_POSE:
            raise _number_error(n, n - 1)
        yield n, image, None if T is None else check_transforms(T, f"T_world_sensor of frame {n}")
    if n == 0:
        raise InputError(_NO_FRAMES)
    if isinstance(poses, np.ndarray) and not at_rest and len(poses) != n:
        raise _number_error(n, len(poses))


def _number_error(frames: int, poses: int) -> InputError:
    return InputError(
        f"T_world_sensor: expected one pose a frame, got {poses} for {frames} frames; give as many, or one (4, 4) for a "
        "sensor at rest"
    )


def _gain(seen: Posterior) -> NDArray[np.float32]:
    """Log density (n,) of a posterior in all possible cells, relative to the uniform distribution."""
    index = seen.index
    if seen.runs is None:
        return np.asarray(seen.log_prob - index.log_possible_weight, np.float32)
    density = (seen.log_prob - np.log(index.mass(seen.cells, seen.runs))).astype(np.float32)
    out = np.zeros(len(index), np.float32)
    out[spelled_out(seen.cells, seen.runs)] = np.repeat(density, seen.runs)
    return out[index.possible]


def _numbered(of: NDArray[np.integer], n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Which of 0 .. n - 1 are among ``of`` (m,), ascending, and the place (n,) of each in that list; -1 for others."""
    live = np.flatnonzero(np.bincount(of, minlength=n))
    row = np.full(n, -1)
    row[live] = np.arange(len(live))
    return live, row


def _shifted(grid: NDArray[np.float32], taps: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """What comes into each cell of ``grid`` from others along ``axis``, by ``taps`` (k + 1,) for 0 .. k cells away."""
    out = np.zeros_like(grid)
    source, target = np.moveaxis(grid, axis, 0), np.moveaxis(out, axis, 0)
    for i, tap in enumerate(taps[1 : len(source)], 1):
        target[i:] += tap * source[:-i]
        target[:-i] += tap * source[i:]
    return out


def _off_diagonal(matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(matrix - np.diag(np.diag(matrix)))
