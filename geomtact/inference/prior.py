"""What was known before the touch (the thesis's P(G), 6.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.carry import Carry
from geomtact.contact_space.index import Index
from geomtact.errors import InputError, UsageError
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.symmetry import Symmetry
from geomtact.inference.posterior import Posterior
from geomtact.scoring.calibration import normalised
from geomtact.se3 import Array, check_pose, check_transforms, exp, hat, inverse, log

LogDensity = Callable[[Array], Array]

_CHUNK = 1 << 16
_EXPECTED = (
    "prior: expected a Posterior, the path of a saved one, a pair (poses (N, 4, 4), log_weights (N,)), a GaussianPrior or a "
    "function of poses, got {}"
)
_DRAWN = 1024  # poses of a Gaussian at a time
_BATCHES, _TOUCHING = 8, 1000  # how often at most, and until how many touch
_FARTHEST = 8.0  # standard deviations from a Gaussian, widened by a cell, that touching poses may be
_LOOK = (24, 32)  # rays that tell which may
_TURNS, _ROTATIONS = 12, 5  # of an axis, and squared of a sphere, at which a prior that is a function is asked


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """A pose known with an uncertainty, T exp(xi^) with xi ~ N(0, covariance): a vision system's, or that of a ``Mode``.

    Its share of a cell is that of poses drawn from it, of those that touch; where it covers too many cells for that, its density
    at the cell's pose, widened by a cell's own spread.

    Attributes
    ----------
    T : (4, 4), in the posterior's frame
    covariance : (6, 6) of xi = (rx, ry, rz, tx, ty, tz), in the object's frame [rad, m], positive definite

    Raises
    ------
    PoseError, InputError
    """

    T: Array
    covariance: Array

    def __post_init__(self) -> None:
        T, C = check_pose(self.T, "GaussianPrior"), np.asarray(self.covariance, float)
        wrong = None
        if C.shape != (6, 6):
            wrong = f"the shape {C.shape}"
        elif not np.allclose(C, C.T):
            wrong = "one that is not symmetric"
        elif not (np.linalg.eigvalsh(C) > 0).all():
            wrong = f"one with an eigenvalue of {np.linalg.eigvalsh(C).min():.2g}"
        if wrong:
            raise InputError(
                "GaussianPrior: expected a symmetric positive definite covariance (6, 6), variances in radians and metres "
                f"squared, got {wrong}"
            )
        object.__setattr__(self, "T", T)
        object.__setattr__(self, "covariance", C)

    def __call__(self, T: Array) -> Array:
        """Log density (n,), not normalised, at poses (n, 4, 4)."""
        xi = log(inverse(self.T) @ T)
        # the exponential takes less volume, the larger the angle (Barfoot, State Estimation for Robotics, ch. 7)
        volume = 4 * np.log(np.sinc(np.linalg.norm(xi[:, :3], axis=1) / (2 * np.pi)))
        return np.asarray(-0.5 * np.einsum("ni,ni->n", xi, np.linalg.solve(self.covariance, xi.T).T) - volume)

    def over_cells(self, index: Index, T_frame_sensor: Array) -> GaussianPrior:
        """As it is told by the cells of ``index`` and by the images under a symmetry that stand for all."""
        assert index.mesh.symmetry is not None
        spread = index.cell_covariance(inverse(T_frame_sensor) @ self.T)
        return GaussianPrior(self.T, self._between_images(index.mesh.symmetry).covariance + spread)

    def _between_images(self, symmetry: Symmetry) -> GaussianPrior:
        """As it is told by the images under a ``symmetry`` that stand for all: wider by what lies between them."""
        free = np.zeros((3, 3)) if symmetry.axis is None else np.outer(symmetry.axis, symmetry.axis) / _TURNS**2
        if symmetry.kind == "sphere":
            free = np.eye(3) / _ROTATIONS**2
        about_centre = np.vstack([np.eye(3), hat(symmetry.centre)])
        return GaussianPrior(self.T, self.covariance + about_centre @ free @ about_centre.T * (2 * np.pi) ** 2 / 12)


@dataclass(frozen=True, eq=False)
class OfAllImages:
    """Log density, not normalised, of a prior that is a function, at poses touching or not: the same for every image of a pose.

    Attributes
    ----------
    prior : a :class:`GaussianPrior` or a function, as in :func:`prior_log_mass`
    symmetry : of the object
    """

    prior: LogDensity
    symmetry: Symmetry

    def __call__(self, T: Array) -> Array:
        """At poses (n, 4, 4)."""
        told = self.prior
        if isinstance(told, GaussianPrior):
            told = told._between_images(self.symmetry)
        return _mean_density([_checked(told(T @ S), len(T)) for S in _images(self.symmetry)])


@dataclass(frozen=True, eq=False)
class NothingFelt:
    """Log density, not normalised, where the object touches none of several sensors.

    Attributes
    ----------
    others : what each sensor but the first told, all without contact
    before : what was known before that; None for nothing
    """

    others: Sequence[Posterior]
    before: LogDensity | None

    def __call__(self, T: Array) -> Array:
        """At poses (n, 4, 4), touching the first sensor or not."""
        density = np.zeros(len(T)) if self.before is None else self.before(T)
        return density + np.sum([other.log_density(T) for other in self.others], axis=0)


def opened(prior: Any, cache_dir: str | Path | None = None) -> Any:
    """``prior``, read where it is the path of a saved posterior."""
    return Posterior.load(prior, cache_dir) if isinstance(prior, str | Path) else prior


def prior_log_mass(index: Index, prior: Any, T_frame_sensor: Array, frame: str) -> NDArray[np.floating]:
    """Log mass (N,) of every cell under ``prior``, normalised; the uniform's without one.

    Parameters
    ----------
    prior : None, a Posterior, a pair (poses (N, 4, 4), log masses (N,)) each of which is spread
        over one grid cell, a :class:`GaussianPrior`, or a function of poses (N, 4, 4) giving the log density relative to the
        uniform. Poses are in ``frame``.

    Raises
    ------
    UsageError, InputError
        Of no known kind, for another object or frame, or ruling out every pose that touches.
    """
    uniform = index.log_weight
    if prior is None:
        return uniform
    if isinstance(prior, Posterior):
        density = _of_posterior(index, prior, T_frame_sensor, frame)
    elif isinstance(prior, GaussianPrior):
        return _of_gaussian(index, prior, T_frame_sensor)
    elif callable(prior):
        density = _over_images(index, lambda T: _checked(prior(T_frame_sensor @ T), len(T)))
    elif isinstance(prior, tuple | list) and len(prior) == 2:
        return normalised(_of_poses(index, prior[0], prior[1], T_frame_sensor))
    else:
        raise UsageError(_EXPECTED.format(type(prior).__name__))
    if not (density < np.inf).all():
        raise InputError(
            "prior: the log density is NaN or infinite at some poses; return -inf where a pose is ruled out"
        )
    return _normalised(uniform + density)


def _normalised(log_mass: NDArray[np.floating]) -> NDArray[np.floating]:
    if not np.isfinite(log_mass).any():
        raise InputError(
            "prior: it rules out every pose that touches the sensor; check its frame and its units (metres)"
        )
    return normalised(log_mass)


def _of_gaussian(index: Index, prior: GaussianPrior, T_frame_sensor: Array) -> NDArray[np.floating]:
    """Log mass (N,) of every cell. Of n poses drawn that touch and k cells among which the widened density spreads, the draws
    count n times, that density k times: as many as it takes to see all those cells."""
    wide = prior.over_cells(index, T_frame_sensor)
    density = _over_images(index, lambda T: wide(T_frame_sensor @ T))
    if density[index.possible].max() < -0.5 * _FARTHEST**2:
        raise InputError(
            f"prior: no pose that touches the sensor lies within about {_FARTHEST:.0f} of its standard deviations, even "
            "widened by a grid cell; check its frame and its units (metres, radians)"
        )
    log_mass = _normalised(index.log_weight + density)
    mass = np.exp(log_mass.astype(float))
    spread = np.exp(-float(mass @ np.maximum(log_mass, -700)))
    rng, cells = np.random.default_rng(0), np.zeros(0, np.int64)
    # a few rays leave out those that cannot touch: what lies between them is hidden, by about their distance at most
    hidden = 2 * float(max(index.sensor.half_window)) / max(_LOOK)
    for _ in range(_BATCHES):
        xi = rng.multivariate_normal(np.zeros(6), prior.covariance, _DRAWN)
        T = inverse(T_frame_sensor) @ prior.T @ exp(xi)
        seen = index.space.caster.depths(index.sensor, T, index.sensor.along(_LOOK)).max((1, 2))
        T = T[(seen >= -hidden) & (seen <= index.sensor.max_penetration)]
        depth = index.space.penetration(T)
        touches = np.isfinite(depth)
        cells = np.append(cells, index.lookup(T[touches], depth[touches]))
        if len(cells) >= _TOUCHING:
            break
    drawn = np.bincount(cells, minlength=len(index))
    with np.errstate(divide="ignore"):
        return np.asarray(np.log((drawn + spread * mass) / (len(cells) + spread)), np.float32)


def prior_log_density(prior: Any, mesh: Mesh, frame: str) -> LogDensity | None:
    """Log density, not normalised, of ``prior`` at poses (n, 4, 4) in ``frame``, touching or not; None without one.

    It is the same for every image of a pose under the object's symmetry. Of a pair, each pose's mass counts for all poses within
    the radius of a mode.
    """
    if prior is None:
        return None
    if isinstance(prior, Posterior):
        check_same(_heading(prior), mesh, frame)
        return prior.log_density
    if callable(prior):
        assert mesh.symmetry is not None
        return OfAllImages(prior, mesh.symmetry)
    if not (isinstance(prior, tuple | list) and len(prior) == 2):
        raise UsageError(_EXPECTED.format(type(prior).__name__))
    poses, mass = _pair(*prior)
    distance, radius = PoseDistance(mesh), mode_radius(mesh)

    def near(T: Array) -> Array:
        return np.array([np.logaddexp.reduce(mass[distance.within(t, poses, radius)], initial=-np.inf) for t in T])

    return near


def check_same(heading: tuple[str, str, str], mesh: Mesh, frame: str) -> None:
    """Refuse a posterior, of whose object ``heading`` gives the name and sha256, and its frame, for another object or frame.

    Raises
    ------
    InputError
    """
    name, sha256, its_frame = heading
    if sha256 != mesh.sha256:
        raise InputError(
            f"prior: it is for the object {name!r}, not for {mesh.name!r} as loaded here; give the same mesh"
        )
    if its_frame != frame:
        raise InputError(
            f"prior: its frame is {its_frame!r} but this posterior's is {frame!r}; give the sensor's pose in the world "
            "(--sensor-poses, T_world_sensor in Python) for both or for neither"
        )


def _heading(prior: Posterior) -> tuple[str, str, str]:
    return prior.mesh.name, prior.mesh.sha256, prior.frame


def _pair(poses: Any, log_masses: Any) -> tuple[Array, Array]:
    """Poses (n, 4, 4) and log masses (n,) of a prior that is a pair."""
    T = check_transforms(poses, "prior poses").reshape(-1, 4, 4)
    mass = np.asarray(log_masses, float)
    if mass.shape != (len(T),) or not (mass < np.inf).all():
        got = f"shape {mass.shape}" if mass.shape != (len(T),) else f"{int((~(mass < np.inf)).sum())} that are"
        raise InputError(
            f"prior: expected one log weight a pose, ({len(T)},), neither NaN nor +inf, got {got}; -inf rules out"
        )
    return T, mass


def _of_posterior(index: Index, prior: Posterior, T_frame_sensor: Array, frame: str) -> Array:
    check_same(_heading(prior), index.mesh, frame)
    if frame == "sensor" and prior.sensor.sha256 != index.sensor.sha256:
        raise InputError(
            f"prior: it is in the frame of the sensor {prior.sensor.name!r}, not of {index.sensor.name!r}; give both sensors' "
            "poses in the world (--sensor-poses, T_world_sensor in Python)"
        )
    if not np.allclose(prior.T_frame_sensor, T_frame_sensor, atol=1e-9):
        return _carried(index, prior, T_frame_sensor)
    if not prior.contact:
        raise InputError(
            "prior: it says that the object does not touch the sensor, but this image shows a contact; leave it out"
        )
    if prior.index.key == index.key:
        return prior.cell_log_density(np.arange(len(index)))
    return _on_another_grid(index, prior)


def _on_another_grid(index: Index, prior: Posterior) -> Array:
    """Log density (N,) in the cells of ``index`` of a prior that the same sensor told on another grid: at each cell's own pose;
    or, where these miss half of what it holds because its cells are the finer ones, as much as lies in each."""
    mass = prior.densities * np.exp(prior.index.log_weight)
    looked_up, out = _home(index, np.arange(len(index)), prior.index), np.full(len(index), -np.inf)
    found = np.flatnonzero(looked_up >= 0)
    covered = mass[np.unique(looked_up[found])].sum()
    if covered < 0.5:
        some = np.flatnonzero(mass > 0)
        home = _home(prior.index, some, index)
        there = np.bincount(home[home >= 0], mass[some[home >= 0]], len(index))
        if covered < 0.5 * there.sum():
            held = there > 0
            out[held] = np.log(there[held]) - index.log_weight[held]
            return out
    out[found] = prior.cell_log_density(looked_up[found])
    return out


def _home(index: Index, ids: NDArray[np.int64], other: Index) -> NDArray[np.int64]:
    """The cell (n,) of ``other`` that holds the pose of each of the cells ``ids`` (n,) of ``index``, at the penetration that they
    stand for; -1 where its approach allows none."""
    out, depths = np.full(len(ids), -1), np.array(index.resolution.penetrations)
    for start in range(0, len(ids), _CHUNK):
        T, depth = index.poses(ids[start : start + _CHUNK]), depths[ids[start : start + _CHUNK] // index.places]
        ok = other.space.approaches(T)
        out[start : start + _CHUNK][ok] = other.lookup(T[ok], depth[ok])
    return out


def _carried(index: Index, prior: Posterior, T_frame_sensor: Array) -> Array:
    """Log density (N,) of a prior that a sensor elsewhere told, in the cells of ``index``: the mean over each, for a cell is
    wider than the gel is deep, so that its own pose seldom touches there."""
    apart = prior.elsewhere
    others, before = (apart.others, apart.before) if isinstance(apart, NothingFelt) else ((), apart)
    density = np.ones(index.places)
    for told in (prior, *others):
        carry = Carry(index, told.index, inverse(told.T_frame_sensor) @ T_frame_sensor)
        density *= carry.mean(told.densities)[0] if told.contact else carry.nothing_felt()
    with np.errstate(divide="ignore"):
        out = np.tile(np.log(density), len(index.height))
    if isinstance(before, OfAllImages):
        known = prior_log_mass(index, before.prior, T_frame_sensor, prior.frame)
        out[index.possible] += known[index.possible] - index.log_possible_weight
    elif before is not None:
        out += _by_chunks(index, lambda T: before(T_frame_sensor @ T))
    return out


def _of_poses(index: Index, poses: Any, log_masses: Any, T_frame_sensor: Array) -> Array:
    T, mass = _pair(poses, log_masses)
    inside = inverse(T_frame_sensor) @ T
    depth = index.space.penetration(inside)
    ok = np.isfinite(depth) & np.isfinite(mass)
    if not ok.any():
        raise InputError(
            "prior: none of its poses touches the sensor; check that they are T_sensor_object (or T_world_object where "
            "T_world_sensor is given), in metres"
        )
    out = np.full(len(index), -np.inf)
    cell = index.lookup(inside[ok], depth[ok])
    np.logaddexp.at(out, cell, mass[ok])
    return out


def _checked(density: Any, n: int) -> Array:
    out = np.asarray(density, float)
    if out.shape != (n,):
        raise InputError(
            f"prior: the function was given {n} poses and returned shape {out.shape}; return one log density a pose, ({n},)"
        )
    return out


def _over_images(index: Index, density: LogDensity) -> Array:
    """Log of the mean of exp(``density``) over the images of every cell's pose under the object's symmetry (N,).

    A cell stands for all of them: what the function says of any is said of it. Images that the approach rules out do
    not count.
    """
    assert index.mesh.symmetry is not None
    images = _images(index.mesh.symmetry)

    def mean(T: Array) -> Array:
        each = np.full((len(images), len(T)), np.nan)
        allowed = np.zeros((len(images), len(T)), bool)
        for i, S in enumerate(images):
            image = T @ S
            allowed[i] = ok = index.space.approaches(image)
            each[i, ok] = density(image[ok])
        return _mean_density(each, allowed)

    return _by_chunks(index, density if len(images) == 1 else mean)


def _images(symmetry: Symmetry) -> Array:
    """Elements (m, 4, 4) of ``symmetry`` at which a prior that is a function is asked."""
    return symmetry.sampled(_TURNS if symmetry.axis is not None else _ROTATIONS)


def _mean_density(each: ArrayLike, counts: NDArray[np.bool_] | None = None) -> Array:
    """Log of the mean density (n,) over images, of the log density (m, n) of ``each``, or of those that count (m, n)."""
    each = np.asarray(each, float)
    counts = np.ones(each.shape, bool) if counts is None else counts
    with np.errstate(invalid="ignore"):  # NaN is told of later
        total = np.logaddexp.reduce(np.where(counts, each, -np.inf), 0)
    return np.asarray(total - np.log(np.maximum(counts.sum(0), 1)))


def _by_chunks(index: Index, density: LogDensity) -> Array:
    """``density`` at the pose of every cell (N,)."""
    return np.concatenate(
        [
            density(index.poses(np.arange(start, min(start + _CHUNK, len(index)))))
            for start in range(0, len(index), _CHUNK)
        ]
    )
