"""How likely an observed contact is at a pose, from the contacts that are cut there at every depth.

The energy of a contact is the integral, over all points where it differs from the observed one, of their distance from the
observed outline, up to a limit. For an outline that is displaced by a smooth field this is half the square of the displacement,
summed along the outline: so the likelihood is that of a normally distributed displacement, and a patch that is missing costs
its area alone.

A rigid gel is touched wherever the object is below the membrane. An elastic one is touched where the pressure is positive: that
is nearly the contact at a share of the depth, half under a ball and less where several features press. Neither the gel nor the
share is known, so both are marginalised over, pose by pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp

from geomtact.contact_space.contact_maps import BLOCK, SHAPE
from geomtact.kernels.contact_energy import DEPTHS, Samples
from geomtact.scoring.outline import from_outline
from geomtact.se3 import Array
from geomtact.sensing.contact import SoftMask
from geomtact.sensing.moments import cleaned
from geomtact.sensing.sensor import Sensor

# Chosen on 100 simulated touches (seed 700) of each of four objects on gelslim, for the mean log density at the true pose and
# equal coverage of rigid and elastic touches; hand-picked among ten settings, not yet fitted.
_RIGID_RATE, _ELASTIC_RATE = 8e9, 4e9  # nats for each m^3 of energy
_CORRELATION = 4e-3  # m of outline that is displaced as one, which sets how the two rates compare
_LIMIT = 2e-3  # m: distance from the observed outline beyond which nothing more is added
_SHARES = np.linspace(
    0.15, 0.75, 7
)  # effective depths of elastic contacts, in shares of the penetration; equally likely
_RIGID = 0.5  # share of touches on a rigid gel


@dataclass(frozen=True, eq=False)
class ContactQuery:
    """An observed contact, ready to be compared.

    Attributes
    ----------
    samples : where and how contacts are compared
    centroid : (2,) of the contact [m]
    area : of the contact, in samples
    outline : length of its outline [m]
    """

    samples: Samples
    centroid: Array
    area: float
    outline: float

    @classmethod
    def of(cls, mask: SoftMask, sensor: Sensor) -> ContactQuery:
        """From the observed ``mask`` (H, W), which shows contact."""
        touched = cleaned(mask, sensor) > 0.5
        pitch = float(np.sqrt(sensor.pixel_area(touched.shape)))
        x, y = sensor.pixel_centres(touched.shape)
        count = touched.sum()
        centroid = np.array([touched.sum(0) @ x, touched.sum(1) @ y]) / count
        edges = (touched[:, 1:] != touched[:, :-1]).sum() + (touched[1:] != touched[:-1]).sum()
        area = count * pitch**2 / sensor.pixel_area(sensor.along(SHAPE))
        return cls(_samples(touched, pitch, sensor), centroid, float(area), float(np.pi / 4 * pitch * edges))

    def log_likelihood(self, energy: NDArray[np.float32], depth: ArrayLike) -> Array:
        """Log likelihood (n,) of the contact at poses whose contacts have ``energy`` (n, depths), up to a constant of the image;
        -inf where that is inf.

        Parameters
        ----------
        depth : (n,) penetration of each pose, in shares of the deepest
        """
        depth = np.asarray(depth, float)
        independent = 0.5 * self.outline / _CORRELATION
        rigid = np.log(_RIGID) + independent * np.log(_RIGID_RATE / _ELASTIC_RATE) - _RIGID_RATE * _at(energy, depth)
        elastic = [-_ELASTIC_RATE * _at(energy, share * depth) for share in _SHARES]
        each = np.log((1 - _RIGID) / len(_SHARES)) + np.stack(elastic)
        return np.asarray(logsumexp(np.concatenate([rigid[None], each]), 0))


def _samples(touched: NDArray[np.bool_], pitch: float, sensor: Sensor) -> Samples:
    """Samples of the window, weighed by their distance from the outline of ``touched`` (H, W)."""
    shape = sensor.along(SHAPE)
    beside = np.clip(from_outline(touched, pitch), -_LIMIT, _LIMIT)
    weight = cv2.resize(beside, shape[::-1], interpolation=cv2.INTER_AREA) * sensor.pixel_area(shape)
    blocks = (shape[0] // BLOCK, shape[1] // BLOCK)
    x, y = sensor.pixel_centres(shape)
    X, Y = sensor.pixel_centres(blocks)
    middle = np.stack(np.meshgrid(X, Y), -1).reshape(-1, 2)
    within = np.stack(np.meshgrid(x[:BLOCK] - X[0], y[:BLOCK] - Y[0]), -1).reshape(-1, 2)
    sag = sensor.sag(*np.meshgrid(x, y))

    def blockwise(image: NDArray[np.floating]) -> NDArray[np.float32]:
        parts = image.reshape(blocks[0], BLOCK, blocks[1], BLOCK).swapaxes(1, 2)
        return np.ascontiguousarray(parts.reshape(-1, BLOCK**2), np.float32)

    weight = blockwise(weight)
    return Samples(
        middle.astype(np.float32), within.astype(np.float32), blockwise(sag), weight, float(np.minimum(weight, 0).sum())
    )


def _at(energy: NDArray[np.float32], depth: Array) -> Array:
    """``energy`` (n, depths) at effective depths ``depth`` (n,), in shares of the deepest: (n,)."""
    where = np.clip(depth, 0, 1) * (DEPTHS - 1)
    below = np.minimum(where.astype(np.int64), DEPTHS - 2)
    row = np.arange(len(energy))
    low, high = energy[row, below].astype(float), energy[row, below + 1].astype(float)
    with np.errstate(invalid="ignore"):
        between = low + (where - below) * (high - low)
    return np.where(np.isfinite(low), between, np.inf)
