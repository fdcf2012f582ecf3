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

Where depths are measured, the likelihood of a contact is that of its outline times that of the depths: normally distributed about
those of the object, where the gel lies on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax
from scipy.stats import beta

from geomtact.contact_space.contact_maps import SHAPE, ContactMaps, Placements
from geomtact.contact_space.index import Index
from geomtact.kernels.contact_energy import BLOCK, SHARES, Cut, Samples
from geomtact.kernels.depth_loss import Indentation
from geomtact.kernels.gel_likelihood import gel_log_likelihood
from geomtact.kernels.parts import by_parts
from geomtact.se3 import Array
from geomtact.sensing.contact import Contact, SoftMask
from geomtact.sensing.moments import cleaned
from geomtact.sensing.sensor import Sensor

# Fitted on procedural objects for the mean log density at the true pose: the shares by ``python -m tools.training likelihood``
# (docs/results/contact-likelihood.json), errors and weights by ``python -m tools.training mixture`` (docs/results/mixture.json).
# Nats for each m^3 of energy: three times the rate that fits best alone, so that the largest power stands for that one.
RATE = 108e9
SHARE = (6.47, 13.18)  # of the beta distribution of an elastic contact's share of the depth
# Of the likelihood, by the posteriors that are mixed; hand-set. A sharper one would have no weight: its evidence is not found.
POWERS = (0.0, 0.01, 0.03, 0.1, 0.3)
# Their weights are the softmax of intercept + slope log(outline / OUTLINE): of a given mask, and of a contact found in an image.
INTERCEPT = {"mask": (-2.88, 0.09, -2.45, 1.77, 0.0), "image": (0.88, 2.81, 0.59, 3.25, 0.0)}
SLOPE = {"mask": (1.08, 6.62, 0.42, 4.27, 0.0), "image": (4.62, 6.43, 1.95, 4.34, 0.0)}
SCALE_ERROR = 0.0025  # half width of the distribution of errors of the object's scale
SHIFT_ERROR = 0.05e-3  # m: that of errors of where a contact is, along each axis
OUTLINE = 15e-3  # m, the length of a usual outline
RIGID = 0.5  # share of touches on a rigid gel
_LIMIT = 2e-3  # m: distance from the observed outline beyond which nothing more is added
_SCALE = 0.05  # standard deviation of a depth, as a share of it, beside the sensor's noise; hand-set
_ALL = 0.99  # of a sample lies on the object, where the gel counts as lying on it
_PART = 2048  # energies that a thread takes at a time
_EVERY = 2  # samples of the window along each axis, of whose depths one is compared


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
    indentation : the depths, where they are measured
    """

    touched: NDArray[np.bool_]
    samples: Samples
    centroid: Array
    area: float
    log_outline: float
    source: str
    indentation: Indentation | None = None

    @classmethod
    def of(
        cls, mask: SoftMask, sensor: Sensor, source: str = "mask", indentation: Indentation | None = None
    ) -> ContactQuery:
        """From the observed ``mask`` (H, W), and the depths of :func:`indentation_of`."""
        return cls.showing(cleaned(mask, sensor) > 0.5, sensor, source, indentation)

    @classmethod
    def showing(
        cls, touched: NDArray[np.bool_], sensor: Sensor, source: str, indentation: Indentation | None = None
    ) -> ContactQuery:
        """From the contact ``touched`` (H, W) without specks."""
        pitch = float(np.sqrt(sensor.pixel_area(touched.shape)))
        count = touched.sum()
        points = sensor.lift(np.stack(np.meshgrid(*sensor.pixel_centres(touched.shape)), -1)[touched])
        centroid = points.mean(0) if count else np.zeros(3)
        area = count * pitch**2 / sensor.pixel_area(sensor.along(SHAPE))
        # a straight line at any angle crosses 4 / pi times as many pairs of neighbours as its length has pixels
        crossed = (touched[:, 1:] != touched[:, :-1]).sum() + (touched[1:] != touched[:-1]).sum()
        log_outline = float(np.log(max(0.25 * np.pi * pitch * crossed, pitch) / OUTLINE))
        samples = _samples(touched, pitch, sensor)
        return cls(touched, samples, centroid, float(area), log_outline, source, indentation)

    def compare(
        self, index: Index, poses: Placements, membrane: Array | None = None, depth: Array | None = None
    ) -> tuple[Cut, Array]:
        """The contacts at n ``poses`` of ``index``, and how likely this one is there: log likelihood (n,), up to a constant of
        the image; -inf where nothing is touched. Parameters are those of ``ContactMaps.compare``, one of the last two."""
        maps = ContactMaps.of(index)
        cut = maps.compare(self.samples, self.area, poses, membrane, depth)
        parts = by_parts(lambda some: gel_log_likelihood(cut.energy[some], RATE, _LOG_SHARE), len(cut.energy), _PART)
        out = np.concatenate(parts)
        touches = np.flatnonzero(np.isfinite(out))
        if self.indentation is not None and len(touches):
            at = cut.reach - depth if depth is not None else membrane
            assert at is not None
            some = Placements(*(each[touches] for each in vars(poses).values()))
            loss = maps.depth_loss(self.indentation, some, at[touches])
            # the largest power stands for the whole likelihood
            out[touches] -= loss * _observations(index.sensor) / POWERS[-1]
        return cut, out

    @property
    def log_likelihood_of_nothing(self) -> float:
        """That of a pose that touches nothing."""
        return RATE * self.samples.least


def mixture_weights(queries: Sequence[ContactQuery]) -> Array:
    """Weights (K,) of the posteriors by ``POWERS``: for contacts of several sensors as for one of their mean length, for each has
    errors of its own."""
    shown = [query for query in queries if query.touched.any()]
    source = "mask" if all(query.source == "mask" for query in shown) else "image"
    log_outline = float(np.logaddexp.reduce([query.log_outline for query in shown]) - np.log(len(shown)))
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


def _observations(sensor: Sensor) -> float:
    """How many independent depths one that is compared stands for: over the area of the correlation exp(-(r / length)^2) there is
    one."""
    return min(1.0, _EVERY**2 * sensor.pixel_area(sensor.along(SHAPE)) / (np.pi * sensor.height_correlation**2))


def indentation_of(contact: Contact, sensor: Sensor) -> Indentation | None:
    """The depths of a ``contact``, where they are measured."""
    height, shape = contact.height, sensor.along(SHAPE)
    if height is None:
        return None
    measured = np.isfinite(height)

    def sampled(image: NDArray[Any]) -> NDArray[np.floating]:
        """The mean over each sample of the window."""
        return np.asarray(cv2.resize(image.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA), float)

    share = sampled(measured)
    depth = sampled(np.where(measured, height, 0)) / np.maximum(share, 1e-6)
    pitch = np.sqrt(sensor.pixel_area(shape))
    # within a sample depths differ by the slope
    slope = np.hypot(*np.gradient(depth, pitch)) * pitch / np.sqrt(12)
    weight = np.zeros(shape)
    some = np.s_[::_EVERY, ::_EVERY]
    variance = sensor.height_noise**2 + (_SCALE * depth) ** 2 + slope**2
    weight[some] = np.where(share > 0.5, 1 / variance, 0)[some]
    lying = _blockwise((sampled(contact.sure) > _ALL).astype(float)) > 0.5
    return placed_indentation(_blockwise(depth), lying, _blockwise(weight), sensor)


def placed_indentation(
    depths: NDArray[np.float32], lying: NDArray[np.bool_], weight: NDArray[np.float32], sensor: Sensor
) -> Indentation:
    """Depths at the samples of a window, all (B, S), seen along the rays of the ``sensor``.

    Raises
    ------
    ValueError
        They are of another window.
    """
    xy = np.stack(np.meshgrid(*sensor.pixel_centres(sensor.along(SHAPE))), -1)
    x, y = _blockwise(xy[..., 0]), _blockwise(xy[..., 1])
    if not x.shape == depths.shape == lying.shape == weight.shape:
        raise ValueError("depths of another window")
    points = sensor.lift(np.stack([x, y], -1), depths)
    place, sag = np.ascontiguousarray(points[..., :2], np.float32), (-points[..., 2] - depths).astype(np.float32)
    return Indentation(depths, np.ascontiguousarray(lying), weight, place, sag)


def _blockwise(image: NDArray[np.floating]) -> NDArray[np.float32]:
    """``image`` of the window's samples in their blocks (B, S)."""
    h, w = image.shape
    parts = image.reshape(h // BLOCK, BLOCK, w // BLOCK, BLOCK).swapaxes(1, 2)
    return np.ascontiguousarray(parts.reshape(-1, BLOCK**2), np.float32)


def _samples(touched: NDArray[np.bool_], pitch: float, sensor: Sensor) -> Samples:
    """Samples of the window, weighed by their distance from the outline of ``touched`` (H, W)."""
    shape = sensor.along(SHAPE)
    beside = np.clip(from_outline(touched, pitch), -_LIMIT, _LIMIT)
    weight = cv2.resize(beside, shape[::-1], interpolation=cv2.INTER_AREA) * sensor.pixel_area(shape)
    blocks = (shape[0] // BLOCK, shape[1] // BLOCK)
    points = sensor.lift(np.stack(np.meshgrid(*sensor.pixel_centres(shape)), -1))

    x, y, z = (_blockwise(points[..., k]) for k in range(3))
    weight = _blockwise(weight)
    least = float(np.minimum(weight, 0).sum())
    block = np.stack([x.mean(1), y.mean(1)], -1)
    within = np.stack([x, y], -1) - block[:, None]
    return Samples(*blocks, block, np.ascontiguousarray(within), -z, weight, least)
