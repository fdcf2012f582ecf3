"""Classical descriptors: contacts as vectors whose Euclidean distance measures their dissimilarity.

Each is a library's own, brought to a grid that does not depend on the resolution of the mask. A vector of d numbers
costs 4 d bytes per pose to store, and one multiplication and addition per number to compare; both stand in each class,
for windows of 4 : 3, with the time that one contact takes to describe on one core. Where a length tunes a descriptor,
it is a share of the window.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomtact.scoring.vectors import Descriptor
from geomtact.sensing.sensor import Sensor

Mask = NDArray[np.bool_]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Chamfer:
    """Distance to the contact, truncated, over the window: Baddeley's metric between two contacts.

    The rms difference between the truncated distance images of two sets (Baddeley 1992) is a metric, so it is symmetric,
    unlike the mean distance from one set's pixels to the other set. Truncated at half the window's short side: on
    coarse grids shorter reaches gain less, because touches of one cell lie that far apart. The distances are OpenCV's
    with a mask of 5 x 5 (Borgefors 1986), 2 % off at most: its exact ones are not the same in every run.

    192 numbers: 768 bytes per pose, 192 multiplications to compare, 0.04 ms to describe.
    """

    reach: float = 0.5  # truncation, in short sides of the window
    name: str = "chamfer"

    def describe(self, masks: Mask, sensor: Sensor) -> Floats:
        """Vectors (m, d) of masks (m, h, w): the distance in units of the truncation."""
        size, small = _grid(sensor, 64), _grid(sensor, 16)
        out = []
        for mask in masks:
            free = 1 - _contact(mask, size)
            away = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_5)  # huge if there is no contact
            out.append(_resample(np.minimum(away / (self.reach * min(size)), 1), small).ravel())
        return np.stack(out)


@dataclass(frozen=True)
class BlurredCosine:
    """Share of contact on 16 x 12 pixels, blurred by two of them; compared by the cosine.

    192 numbers: 768 bytes per pose, 192 multiplications to compare, 0.02 ms to describe.
    """

    blur: float = 2.0  # standard deviation, in pixels of the small image
    name: str = "cosine"

    def describe(self, masks: Mask, sensor: Sensor) -> Floats:
        """Unit vectors (m, d) of masks (m, h, w); zeros for a mask without contact."""
        small = (_resample(mask, _grid(sensor, 16)) for mask in masks)
        blurred = [cv2.GaussianBlur(s, (0, 0), self.blur, borderType=cv2.BORDER_CONSTANT).ravel() for s in small]
        return _unit(np.stack(blurred))


@dataclass(frozen=True)
class Hu:
    """Hu's seven moment invariants, as signed logarithms, from scikit-image.

    Blind to place, turn and size by design: they describe what was touched, not where in the window. What lies below
    1e-5 counts as nothing, as in OpenCV's ``matchShapes``; so the logarithm does not jump where a moment changes its
    sign. scikit-image's takes ten times as long as OpenCV's, but supports pixels that are not square.

    7 numbers: 28 bytes per pose, 7 multiplications to compare, 0.1 ms to describe.
    """

    least: float = 1e-5
    name: str = "hu"

    def describe(self, masks: Mask, sensor: Sensor) -> Floats:
        """Vectors (m, 7) of masks (m, h, w); zeros for a mask without contact."""
        from skimage.measure import moments_central, moments_hu, moments_normalized

        pixel = tuple(2 * sensor.half_window[::-1] / masks.shape[1:])
        out = np.zeros((len(masks), 7))
        for i in np.flatnonzero(masks.any((1, 2))):
            central = moments_central(masks[i], order=3, spacing=pixel)
            out[i] = moments_hu(moments_normalized(central, order=3, spacing=pixel))
        return (np.sign(out) * np.log10(np.maximum(np.abs(out) / self.least, 1))).astype(np.float32)


@dataclass(frozen=True)
class Hog:
    """Histograms of oriented gradients (Dalal and Triggs 2005), from OpenCV: cells of 16 pixels, blocks of 2 x 2 cells.

    The window is 64 x 48 pixels. The orientations are unsigned, which gains more than signed ones, and 8, so that a
    quarter turn maps them onto each other. scikit-image has the same descriptor, at six times the time.

    192 numbers: 768 bytes per pose, 192 multiplications to compare, 0.05 ms to describe.
    """

    cell: int = 16
    name: str = "hog"

    def describe(self, masks: Mask, sensor: Sensor) -> Floats:
        """Vectors (m, d) of masks (m, h, w), each block of unit length or zero."""
        size = _grid(sensor, 4 * self.cell, self.cell)
        cell = (self.cell, self.cell)
        hog = cv2.HOGDescriptor(size, (2 * self.cell, 2 * self.cell), cell, cell, 8)
        return np.stack([np.ravel(hog.compute(255 * _contact(mask, size))) for mask in masks])


@dataclass(frozen=True)
class Fourier:
    """Low Fourier coefficients of the outline of the largest patch, as a curve in the complex plane.

    The mean is the place, the first harmonics are size, elongation and direction, the next ones the shape; all in units
    of the window's half diagonal. By Parseval's theorem the distance of two vectors is the rms distance of the smoothed
    outlines, point by point. The start point is where the first harmonic crosses +x, so that no turn makes it jump.
    Further patches do not count.

    18 numbers: 72 bytes per pose, 18 multiplications to compare, 0.07 ms to describe.
    """

    harmonics: int = 4  # of each direction of travel
    points: int = 64  # along the outline
    name: str = "fourier"

    def describe(self, masks: Mask, sensor: Sensor) -> Floats:
        """Vectors (m, 2 + 4 harmonics) of masks (m, h, w); zeros for a mask without contact."""
        spectrum = np.fft.fft(np.stack([self._outline(mask, sensor) for mask in masks]), axis=1) / self.points
        k = np.rint(np.fft.fftfreq(self.points, 1 / self.points))
        spectrum *= np.exp(-1j * np.angle(spectrum[:, 1:2]) * k)
        low = spectrum[:, np.abs(k) <= self.harmonics]
        return np.concatenate([low.real, low.imag], 1).astype(np.float32)

    def _outline(self, mask: Mask, sensor: Sensor) -> NDArray[np.complex128]:
        """Points (n,) evenly along the outline of the largest patch, from +x towards +y [half diagonals]."""
        width, height = _grid(sensor, 128)  # fine, because an outline runs through the centres of its pixels
        outlines, _ = cv2.findContours(_contact(mask, (width, height)), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        if not outlines:
            return np.zeros(self.points, complex)
        column, row = max(outlines, key=cv2.contourArea)[::-1, 0].T
        x, y = sensor.pixel_centres((height, width))
        curve = (x[column] + 1j * y[row]) / np.hypot(*sensor.half_window)
        closed = np.append(curve, curve[0])
        along = np.append(0, np.cumsum(np.abs(np.diff(closed))))
        return np.interp(np.arange(self.points) / self.points * along[-1], along, closed)


@dataclass(frozen=True)
class Fpfh:
    """Fast point feature histograms (Rusu et al. 2009) of the contact's heights, from Open3D, averaged over its points.

    A mask holds no heights, so the same ones are made up for stored and for observed contacts: a dome over the contact,
    sqrt(d (2 D - d)) at the distance d from the rim, which is at most D. Over a disk it is a half sphere, the shape of
    the pressure under a ball (Hertz). Blind to place and turn, as the features are. Compared by the Hellinger distance.

    33 numbers: 132 bytes per pose, 33 multiplications to compare, 0.1 ms to describe a small
    contact, 4 ms one that fills the window.
    """

    radius: float = 4.0  # of the neighbourhood, in 1/32 of the window's long side
    name: str = "fpfh"

    def describe(self, masks: Mask, sensor: Sensor) -> Floats:
        """Unit vectors (m, 33) of masks (m, h, w); zeros where no point has a neighbour."""
        size = _grid(sensor, 32)
        mean = np.stack([self._mean_histogram(np.pad(_contact(mask, size), 1)) for mask in masks])
        return _unit(np.sqrt(mean).astype(np.float32))

    def _mean_histogram(self, contact: NDArray[np.uint8]) -> NDArray[Any]:
        """Mean feature (33,) over the points of the dome over ``contact`` (h, w), which leaves the image's rim free."""
        import open3d as o3d

        inside = contact > 0
        if not inside.any():
            return np.zeros(33)
        rim = cv2.distanceTransform(contact, cv2.DIST_L2, cv2.DIST_MASK_5)
        height = np.sqrt(rim * (2 * rim.max() - rim))
        slope_y, slope_x = np.gradient(height)
        row, column = np.nonzero(inside)
        normals = np.stack([-slope_x[inside], -slope_y[inside], np.ones(len(row))], 1)
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.stack([column, row, height[inside]], 1)))
        cloud.normals = o3d.utility.Vector3dVector(normals)
        cloud.normalize_normals()
        near = o3d.geometry.KDTreeSearchParamRadius(self.radius)
        compute: Any = o3d.pipelines.registration.compute_fpfh_feature  # its stub makes a third argument obligatory
        return compute(cloud, near).data.mean(1)


def _grid(sensor: Sensor, long_side: int, step: int = 1) -> tuple[int, int]:
    """Columns and rows of a grid over the window: about square pixels, multiples of ``step``."""
    sides = long_side * sensor.half_window / sensor.half_window.max()
    columns, rows = np.maximum(np.rint(sides / step), 2).astype(int) * step
    return int(columns), int(rows)


def _resample(image: NDArray[Any], size: tuple[int, int]) -> Floats:
    """``image`` (h, w) on a grid of ``size`` = (columns, rows) over the same window: means, or interpolated if finer."""
    shrinks = size[0] <= image.shape[1] and size[1] <= image.shape[0]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image.astype(np.float32), size, interpolation=how), np.float32)


def _contact(mask: Mask, size: tuple[int, int]) -> NDArray[np.uint8]:
    """``mask`` (h, w) on a grid of ``size``: 1 where most of the pixel is contact, else 0."""
    return (_resample(mask, size) >= 0.5).astype(np.uint8)


def _unit(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1), np.float32)


CLASSICAL: dict[str, Descriptor] = {d.name: d for d in (Chamfer(), BlurredCosine(), Hu(), Hog(), Fourier(), Fpfh())}
