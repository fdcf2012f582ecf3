"""The prior (the thesis's P(G), 6.2) in each form that a user may give."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.index import Index
from geomtact.errors import InputError, UsageError
from geomtact.geometry.mesh import Mesh
from geomtact.inference.densities import LogDensity, OfAllImages, OfPoses, likeliest_images
from geomtact.inference.gaussian_prior import GaussianPrior
from geomtact.inference.posterior import Posterior
from geomtact.inference.prior_cells import log_mass_of_density, log_mass_of_poses, log_mass_of_posterior, stands_as
from geomtact.inference.reference import Reference
from geomtact.se3 import Array, check_transforms
from geomtact.sensing.sensor import Sensor

_MODES, _POSES = 10, 1000  # modes of a function, and poses of a pair, in the reference of symmetric images; hand-set
_EXPECTED = (
    "prior: expected a Posterior, the path of a saved one, a pair (poses (N, 4, 4), log_weights (N,)), a GaussianPrior or a "
    "function of poses, got {}"
)


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
        Of an unsupported type, for another object or frame, or ruling out every pose that touches.
    """
    if prior is None:
        return index.log_weight
    if isinstance(prior, Posterior):
        _check_posterior(prior, index, frame)
        return log_mass_of_posterior(index, prior, T_frame_sensor)
    if callable(prior):
        return log_mass_of_density(index, prior, T_frame_sensor)
    return log_mass_of_poses(index, *_pair(prior), T_frame_sensor)


def lost_contact(prior: Any, sensor: Sensor, T_frame_sensor: Array) -> bool:
    """Whether ``prior`` requires the object to touch the sensor at ``T_frame_sensor`` (4, 4)."""
    return isinstance(prior, Posterior) and prior.contact and stands_as(prior, sensor, T_frame_sensor)


def prior_log_density(index: Index, prior: Any, frame: str) -> LogDensity | None:
    """Log density, not normalised, of ``prior`` at poses (n, 4, 4) in ``frame``, touching or not; None without one.

    It is the same for every image of a pose under the object's symmetry. Of a pair, each pose's mass counts for all poses within
    the radius of a mode.

    Raises
    ------
    UsageError, InputError
        Of an unsupported type, or for another object or frame.
    """
    mesh = index.mesh
    if prior is None:
        return None
    if isinstance(prior, Posterior):
        _check_posterior(prior, index, frame)
        return prior.log_density
    if callable(prior):
        assert mesh.symmetry is not None
        return OfAllImages(prior, mesh.symmetry)
    return OfPoses(*_pair(prior), mesh)


def reference_of(prior: Any, posterior: Posterior) -> Reference | None:
    """The poses of ``prior`` by which the modes of ``posterior``, made with it, are reported at one of their images; None without
    symmetry.

    They are a Gaussian's pose, the first mode of a posterior, the poses of a pair, or of each mode of ``posterior`` the image at
    which a function is largest, the first of those that tie.
    """
    if prior is None or posterior.mesh.symmetry is None or posterior.mesh.symmetry.kind == "none":
        return None
    if isinstance(prior, GaussianPrior):
        return Reference(prior.T[None], np.zeros(1))
    if isinstance(prior, Posterior):
        return Reference(prior.modes(1)[0].T[None], np.zeros(1)) if prior.contact else prior.reference
    if callable(prior):
        modes = posterior.modes(_MODES)
        if not modes:
            return None
        T = likeliest_images(prior, np.stack([mode.T for mode in modes]), posterior)
        return Reference(T, np.log([mode.probability for mode in modes]))
    poses, log_mass = _pair(prior)
    likely = log_mass > -np.inf
    if not likely.any():
        return None
    poses, log_mass = poses[likely], log_mass[likely]
    if len(poses) > _POSES:  # as many, each as likely to be among them as it has mass
        upto = np.cumsum(np.exp(log_mass - log_mass.max()))
        drawn = np.searchsorted(upto, (np.arange(_POSES) + 0.5) / _POSES * upto[-1])
        poses, log_mass = poses[drawn], np.zeros(_POSES)
    return Reference(poses, log_mass)


def _check_posterior(prior: Posterior, index: Index, frame: str) -> None:
    """Refuse a posterior that is not of the object of ``index``, or is in another frame, if only another sensor's."""
    check_same((prior.mesh.name, prior.mesh.sha256, prior.frame), index.mesh, frame)
    if frame == "sensor" and prior.sensor.sha256 != index.sensor.sha256:
        raise InputError(
            f"prior: it is in the frame of the sensor {prior.sensor.name!r}, not of {index.sensor.name!r}; give both "
            "sensors' poses in the world (--sensor-poses, T_world_sensor in Python)"
        )


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


def _pair(prior: Any) -> tuple[Array, Array]:
    """Poses (n, 4, 4) and log masses (n,) of a prior that is a pair."""
    if not (isinstance(prior, tuple | list) and len(prior) == 2):
        raise UsageError(_EXPECTED.format(type(prior).__name__))
    poses, log_mass = prior
    T = check_transforms(poses, "prior poses").reshape(-1, 4, 4)
    mass = np.asarray(log_mass, float)
    if mass.shape != (len(T),) or not (mass < np.inf).all():
        got = f"shape {mass.shape}" if mass.shape != (len(T),) else f"{int((~(mass < np.inf)).sum())} that are"
        raise InputError(
            f"prior: expected one log weight a pose, ({len(T)},), neither NaN nor +inf, got {got}; -inf rules out"
        )
    return T, mass
