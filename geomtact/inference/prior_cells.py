"""The prior (the thesis's P(G), 6.2) as the mass of every cell of an index."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geomtact.contact_space.cell_transfer import CellTransfer
from geomtact.contact_space.index import Index
from geomtact.errors import InputError
from geomtact.inference.densities import (
    LogDensity,
    NoContactDensity,
    OfAllImages,
    checked,
    images,
    over_images,
)
from geomtact.inference.distribution import cell_densities, cell_log_density
from geomtact.inference.gaussian_prior import GaussianPrior, given_turns
from geomtact.inference.posterior import Posterior
from geomtact.log_mass import log_mean_of_counted, normalised
from geomtact.se3 import Array, inverse, left_jacobian, transform
from geomtact.sensing.sensor import Sensor

_CHUNK = 1 << 16
_DRAWN = 1024  # poses drawn from a Gaussian at a time; hand-set, as are the next three
_BATCHES, _TOUCHING = 3, 500  # largest number of such draws, and number of touching poses at which they end
_FARTHEST = 8.0  # largest distance of a touching pose from a Gaussian widened by a cell, in standard deviations
_LOOK = (24, 32)  # rays by which poses that cannot touch are left out


def log_mass_of_density(index: Index, density: LogDensity, T_frame_sensor: Array) -> NDArray[np.floating]:
    """Log mass (N,) of every cell, of a log ``density``, relative to the uniform one, at poses (n, 4, 4) in a frame in which the
    sensor lies at ``T_frame_sensor`` (4, 4).

    Raises
    ------
    InputError
        It is NaN or infinite at some poses, or rules out every pose that touches.
    """
    if isinstance(density, GaussianPrior):
        return _of_gaussian(index, density, T_frame_sensor)
    return _log_mass(index, _over_images(index, lambda T: checked(density(T_frame_sensor @ T), len(T))))


def log_mass_of_poses(index: Index, T: Array, log_mass: Array, T_frame_sensor: Array) -> NDArray[np.floating]:
    """Log mass (N,) of every cell, of poses ``T`` (n, 4, 4), each of which is spread over its cell.

    Raises
    ------
    InputError
        None of them touches.
    """
    inside = inverse(T_frame_sensor) @ T
    depth = index.space.penetration(inside)
    ok = np.isfinite(depth) & np.isfinite(log_mass)
    if not ok.any():
        raise InputError(
            "prior: none of its poses touches the sensor; check that they are T_sensor_object (or T_world_object where "
            "T_world_sensor is given), in metres"
        )
    out = np.full(len(index), -np.inf)
    np.logaddexp.at(out, index.lookup(inside[ok], depth[ok]), log_mass[ok])
    return normalised(out)


def log_mass_of_posterior(index: Index, prior: Posterior, T_frame_sensor: Array) -> NDArray[np.floating]:
    """Log mass (N,) of every cell, of a posterior of the same sensor on any grid, or of another in the same frame.

    Raises
    ------
    InputError
        The same sensor had no contact at the same pose.
    """
    if not stands_as(prior, index.sensor, T_frame_sensor):
        return _log_mass(index, _carried(index, prior, T_frame_sensor))
    if not prior.contact:
        raise InputError(
            "prior: by it the object does not touch the sensor, but this image shows a contact; leave it out"
        )
    if prior.index.key == index.key:
        return _log_mass(index, cell_log_density(prior, np.arange(len(index))))
    return _log_mass(index, _on_another_grid(index, prior))


def stands_as(prior: Posterior, sensor: Sensor, T_frame_sensor: Array) -> bool:
    """Whether ``prior`` is of this sensor, where it stands at ``T_frame_sensor`` (4, 4)."""
    at = np.allclose(prior.T_frame_sensor, T_frame_sensor, rtol=0, atol=1e-9)
    return bool(at) and prior.sensor.sha256 == sensor.sha256


def _log_mass(index: Index, density: NDArray[np.floating]) -> NDArray[np.floating]:
    """Log mass (N,) of every cell, of the log density (N,) in it, relative to the uniform one."""
    if not (density < np.inf).all():
        raise InputError(
            "prior: the log density is NaN or infinite at some poses; return -inf where a pose is ruled out"
        )
    log_mass = index.log_weight + density
    if not np.isfinite(log_mass).any():
        raise InputError(
            "prior: it rules out every pose that touches the sensor; check its frame and its units (metres)"
        )
    return normalised(log_mass)


def _of_gaussian(index: Index, prior: GaussianPrior, T_frame_sensor: Array) -> NDArray[np.floating]:
    """Log mass (N,) of every cell. Of n poses drawn that touch and k cells among which the widened density spreads, the draws
    count n times, that density k times: as many as it takes to see all those cells."""
    assert index.mesh.symmetry is not None
    cell = index.cell_covariance(inverse(T_frame_sensor) @ prior.T)
    wide = GaussianPrior(prior.T, over_images(prior, index.mesh.symmetry).covariance + cell)
    density = _density_of_gaussian(index, wide, T_frame_sensor)
    if density[index.possible].max() < -0.5 * _FARTHEST**2:
        raise InputError(
            f"prior: no pose that touches the sensor lies within about {_FARTHEST:.0f} of its standard deviations, even "
            "widened by a grid cell; check its frame and its units (metres, radians)"
        )
    log_mass = _log_mass(index, density)
    mass = np.exp(log_mass.astype(float))
    spread = np.exp(-float(mass @ np.maximum(log_mass, -700)))
    rng, cells = np.random.default_rng(0), np.zeros(0, np.int64)
    # a few rays leave out those that cannot touch: what lies between them is hidden, by about their distance at most
    hidden = 2 * float(max(index.sensor.half_window)) / max(_LOOK)
    for _ in range(_BATCHES):
        T = inverse(T_frame_sensor) @ prior.draw(_DRAWN, rng)
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


def _density_of_gaussian(index: Index, prior: GaussianPrior, T_frame_sensor: Array) -> Array:
    """Log density (N,) of a Gaussian in all cells, the mean over the images under the symmetry; an upper bound where the rotation
    alone is too far.

    Given a rotation, xi is linear in where the object's centre is: so the logarithm is taken of the rotations alone.
    """
    assert index.mesh.symmetry is not None
    expected = inverse(T_frame_sensor) @ prior.T
    R, middle = expected[:3, :3], index.mesh.centre
    covariance = prior.covariance_about(middle)
    gain, left = given_turns(covariance, 3)
    root = np.linalg.cholesky(np.linalg.inv(left)).T
    off = np.concatenate([np.broadcast_to(index.shift, (*index.height.shape, 2)), index.height[..., None]], -1)
    off = off - (R @ middle + expected[:3, 3])
    each, allowed = [], []
    for S in images(index.mesh.symmetry):
        w = Rotation.from_matrix(R.T @ index.rotations @ S[:3, :3]).as_rotvec()
        of_turn = -0.5 * np.einsum("mi,mi->m", w, np.linalg.solve(covariance[:3, :3], w.T).T)
        log_density = np.tile(of_turn[index.rotation], (len(index.height), 1))
        near = np.flatnonzero(of_turn[index.rotation] > -0.5 * _FARTHEST**2)
        row = index.rotation[near]
        along = (root @ np.linalg.inv(left_jacobian(w)) @ R.T)[row]
        x = np.einsum("nij,lnj->lni", along, off[:, near]) - (w @ gain.T @ root.T)[row]
        log_density[:, near] -= 0.5 * np.square(x).sum(-1)
        each.append(log_density.ravel())
        ok = index.space.approaches(transform(index.rotations @ S[:3, :3], np.zeros(3)))
        allowed.append(np.tile(ok[index.rotation], len(index.height)))
    return each[0] if len(each) == 1 else log_mean_of_counted(each, np.stack(allowed))


def _on_another_grid(index: Index, prior: Posterior) -> Array:
    """Log density (N,) in the cells of ``index`` of a posterior of the same sensor on another grid.

    Of the prior's cells, those in which a cell's own pose lies share out what they hold together by their density at these poses;
    the mass of all others goes to the cells in which their own poses lie.
    """
    mass = cell_densities(prior) * np.exp(prior.index.log_weight)
    looked_up = _home(index, np.arange(len(index)), prior.index)
    found = np.flatnonzero(looked_up >= 0)
    mass_here = np.zeros(len(index))
    mass_here[found] = np.exp(index.log_weight[found] + cell_log_density(prior, looked_up[found]))
    seen = np.unique(looked_up[found])
    mass_here *= mass[seen].sum() / max(mass_here.sum(), 1e-300)
    mass[seen] = 0
    rest = np.flatnonzero(mass > 0)
    home = _home(prior.index, rest, index)
    mass_here += np.bincount(home[home >= 0], mass[rest[home >= 0]], len(index))
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(mass_here) - np.where(mass_here > 0, index.log_weight, 0))


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
    """Log density (N,) in the cells of ``index``, of the posterior of a sensor elsewhere: the mean over each cell.

    A cell is wider than the gel is deep, so its own pose seldom touches there.
    """
    apart = prior.off_contact_log_density
    others, earlier = (apart.others, apart.prior) if isinstance(apart, NoContactDensity) else ((), apart)
    density = np.ones(index.places)
    for each in (prior, *others):
        transfer = CellTransfer(index, each.index, inverse(each.T_frame_sensor) @ T_frame_sensor)
        density *= transfer.mean(cell_densities(each))[0] if each.contact else transfer.no_contact_likelihood()
    with np.errstate(divide="ignore"):
        out = np.tile(np.log(density), len(index.height))
    if isinstance(earlier, OfAllImages):
        log_mass = log_mass_of_density(index, earlier.prior, T_frame_sensor)
        out[index.possible] += log_mass[index.possible] - index.log_possible_weight
    elif earlier is not None:
        out += _by_chunks(index, lambda T: earlier(T_frame_sensor @ T))
    return out


def _over_images(index: Index, density: LogDensity) -> Array:
    """Log of the mean of exp(``density``) over the images of every cell's pose under the object's symmetry (N,).

    A cell stands for all of these images. Those that the approach rules out do not count.
    """
    assert index.mesh.symmetry is not None
    symmetric = images(index.mesh.symmetry)

    def mean(T: Array) -> Array:
        each = np.full((len(symmetric), len(T)), np.nan)
        allowed = np.zeros((len(symmetric), len(T)), bool)
        for i, S in enumerate(symmetric):
            image = T @ S
            allowed[i] = ok = index.space.approaches(image)
            each[i, ok] = density(image[ok])
        return log_mean_of_counted(each, allowed)

    return _by_chunks(index, density if len(symmetric) == 1 else mean)


def _by_chunks(index: Index, density: LogDensity) -> Array:
    """``density`` at the pose of every cell (N,)."""
    return np.concatenate(
        [
            density(index.poses(np.arange(start, min(start + _CHUNK, len(index)))))
            for start in range(0, len(index), _CHUNK)
        ]
    )
