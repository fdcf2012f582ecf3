"""How likely an observed contact is at a pose, from the contacts that are cut there at every depth.

The energy of a contact is the integral, over all points where it differs from the observed one, of their distance from the
observed outline, up to a limit. For an outline that is displaced by a smooth field this is half the square of the displacement,
summed along the outline: so the likelihood is that of a normally distributed displacement, and a patch that is missing costs
its area alone.

A rigid gel is touched wherever the object is below the membrane. An elastic one is touched where the pressure is positive: that
is nearly where the object is within a share of the local depth from the deepest point, half of it under a ball and less where
several features press. Neither the gel nor the share is known, so both are marginalised over, pose by pose.

How far a contact is from any simulated one is not known either: by the noise alone, or by a gel that differs from the model. So
the posterior is a mixture of posteriors, each by a power of the likelihood: 0 gives the coarse one, 1 that of the whole
likelihood. Errors are correlated along an outline, so information grows more slowly than its length: the weights depend on it.
They are fitted like all else by the log score ("covariate-dependent stacking", Yao et al. 2022).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax
from scipy.stats import beta

from geomtact.contact_space.contact_maps import SHAPE
from geomtact.kernels.contact_energy import BLOCK, SHARES, Samples
from geomtact.kernels.gel_likelihood import gel_log_likelihood
from geomtact.se3 import Array
from geomtact.sensing.contact import SoftMask
from geomtact.sensing.moments import cleaned
from geomtact.sensing.sensor import Sensor

# Fitted on procedural objects for the mean log density at the true pose: the shares by ``python -m tools.training likelihood``
# (docs/results/contact-likelihood.json), errors and weights by ``python -m tools.training mixture`` (docs/results/mixture.json).
# Nats for each m^3 of energy: three times the rate that fits best alone, so that the largest power stands for that one.
RATE = 108e9
SHARE = (6.47, 13.18)  # of the beta distribution of an elastic contact's share of the depth
# Of the likelihood, by the posteriors that are mixed; hand-set. A sharper one would have no weight: its evidence is not found.
POWERS = (0.0, 0.01, 0.03, 0.1, 0.3)
# Their weights are the softmax of intercept + slope log(outline / OUTLINE): of a given mask, and of a contact found in an image,
# perhaps badly.
INTERCEPT = {"mask": (-4.68, -3.09, -0.64, 0.63, 0.0), "image": (-2.48, 0.27, 0.93, 1.41, 0.0)}
SLOPE = {"mask": (0.14, 0.56, 2.74, 2.82, 0.0), "image": (0.75, 2.56, 3.34, 2.85, 0.0)}
SCALE_ERROR = 0.0025  # half width of the distribution of errors of the object's scale
SHIFT_ERROR = 0.05e-3  # m: that of errors of where a contact is, along each axis
OUTLINE = 15e-3  # m, the length of a usual outline
RIGID = 0.5  # share of touches on a rigid gel
_LIMIT = 2e-3  # m: distance from the observed outline beyond which nothing more is added


@dataclass(frozen=True, eq=False)
class ContactQuery:
    """An observed contact, or that there is none, ready to be compared.

    Attributes
    ----------
    touched : (H, W) bool, the contact without specks
    samples : where and how contacts are compared
    centroid : (3,) of the contact, on the membrane [m]
    area : of the contact, in samples
    log_outline : log of the length of its outline over ``OUTLINE``
    source : "mask", or "image" where it was found in one
    """

    touched: NDArray[np.bool_]
    samples: Samples
    centroid: Array
    area: float
    log_outline: float
    source: str

    @classmethod
    def of(cls, mask: SoftMask, sensor: Sensor, source: str = "mask") -> ContactQuery:
        """From the observed ``mask`` (H, W), which shows contact."""
        return cls.showing(cleaned(mask, sensor) > 0.5, sensor, source)

    @classmethod
    def showing(cls, touched: NDArray[np.bool_], sensor: Sensor, source: str) -> ContactQuery:
        """From the contact ``touched`` (H, W) without specks."""
        pitch = float(np.sqrt(sensor.pixel_area(touched.shape)))
        count = touched.sum()
        points = sensor.lift(np.stack(np.meshgrid(*sensor.pixel_centres(touched.shape)), -1)[touched])
        centroid = points.mean(0) if count else np.zeros(3)
        area = count * pitch**2 / sensor.pixel_area(sensor.along(SHAPE))
        # a straight line at any angle crosses 4 / pi times as many pairs of neighbours as its length has pixels
        crossed = (touched[:, 1:] != touched[:, :-1]).sum() + (touched[1:] != touched[:-1]).sum()
        log_outline = float(np.log(max(0.25 * np.pi * pitch * crossed, pitch) / OUTLINE))
        return cls(touched, _samples(touched, pitch, sensor), centroid, float(area), log_outline, source)

    def log_likelihood(self, energy: NDArray[np.float32]) -> Array:
        """Log likelihood (n,) of the contact at poses whose contacts have ``energy`` (n, SHARES), up to a constant of the image;
        -inf where that is inf."""
        return gel_log_likelihood(energy, RATE, _LOG_SHARE)

    @property
    def log_likelihood_of_nothing(self) -> float:
        """That of a pose that touches nothing."""
        return RATE * self.samples.least


def mixture_weights(queries: Sequence[ContactQuery]) -> Array:
    """Weights (K,) of the posteriors by ``POWERS``, for contacts of several sensors as for one that is as long as all of them."""
    shown = [query for query in queries if query.touched.any()]
    source = "mask" if all(query.source == "mask" for query in shown) else "image"
    log_outline = float(np.logaddexp.reduce([query.log_outline for query in shown]))
    return np.asarray(softmax(np.array(INTERCEPT[source]) + np.array(SLOPE[source]) * log_outline))


def share_cells() -> tuple[Array, Array]:
    """A share of the depth in the middle of each of the cells (SHARES,) about the shares that are compared, and their widths."""
    edges = np.minimum((np.arange(SHARES + 1) + 0.5) / SHARES, 1) ** 2
    edges[0] = 0
    return 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)


def _log_shares() -> Array:
    """Log probability (SHARES,) of the shares of the depth, the last one a rigid gel's too."""
    middle, width = share_cells()
    elastic = beta.pdf(middle, *SHARE) * width
    elastic *= (1 - RIGID) / elastic.sum()
    elastic[-1] += RIGID
    return np.log(np.maximum(elastic, 1e-300))


_LOG_SHARE = _log_shares()


def from_outline(mask: NDArray[np.bool_], pitch: float) -> NDArray[np.float32]:
    """How far (H, W) [m] each pixel is outside the outline of ``mask``, negative inside; the window's border is no outline."""
    image = mask.astype(np.uint8)
    far = float(np.hypot(*mask.shape))
    off = [
        cv2.distanceTransform(side, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5
        if not side.all()
        else np.full(mask.shape, far, np.float32)
        for side in (1 - image, image)
    ]
    return np.asarray(pitch * np.where(mask, -off[1], off[0]), np.float32)


def _samples(touched: NDArray[np.bool_], pitch: float, sensor: Sensor) -> Samples:
    """Samples of the window, weighed by their distance from the outline of ``touched`` (H, W)."""
    shape = sensor.along(SHAPE)
    beside = np.clip(from_outline(touched, pitch), -_LIMIT, _LIMIT)
    weight = cv2.resize(beside, shape[::-1], interpolation=cv2.INTER_AREA) * sensor.pixel_area(shape)
    blocks = (shape[0] // BLOCK, shape[1] // BLOCK)
    points = sensor.lift(np.stack(np.meshgrid(*sensor.pixel_centres(shape)), -1))

    def blockwise(image: NDArray[np.floating]) -> NDArray[np.float32]:
        parts = image.reshape(blocks[0], BLOCK, blocks[1], BLOCK).swapaxes(1, 2)
        return np.ascontiguousarray(parts.reshape(-1, BLOCK**2), np.float32)

    x, y, z = (blockwise(points[..., k]) for k in range(3))
    weight = blockwise(weight)
    least = float(np.minimum(weight, 0).sum())
    block = np.stack([x.mean(1), y.mean(1)], -1)
    within = np.stack([x, y], -1) - block[:, None]
    return Samples(*blocks, block, np.ascontiguousarray(within), -z, weight, least)
