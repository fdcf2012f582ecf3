"""A simulated touch: the rigid or elastic contact at a pose, with sensor noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.space import ContactSpace
from geomtact.sensing.elastic import elastic_contact, elastic_mask
from geomtact.sensing.noise import Noise, perturb

CALIBRATION_NOISE = Noise(outline_rms=0.5e-3, correlation=(0.5e-3, 4e-3), specks=5, missing_probability=0.2)
LEAST_CONTACT = 1e-6  # m^2: touches of less are not simulated
MARGIN = 0.25  # of the window, on each side: the gel is dragged along by what presses beside the window


def simulate_mask(
    space: ContactSpace, T: ArrayLike, elastic: bool, shape: tuple[int, int] | None = None
) -> NDArray[np.bool_]:
    """The contact mask of the object at ``T`` (4, 4), without noise: (h, w) bool over the window.

    Parameters
    ----------
    elastic : the gel is an elastic half-space, touched where the pressure is positive; else the thesis's threshold
    shape : (h, w) of the result, the image's own by default
    """
    sensor = space.sensor
    h, w = shape or sensor.image_size_px[::-1]
    if not elastic:
        return space.caster.contact(sensor, T, (h, w)).mask
    depth, pitch, margin = _around(space, T, (h, w))
    return elastic_in_window(depth, pitch, margin, sensor.max_penetration)


def simulate_depth_map(
    space: ContactSpace,
    T: ArrayLike,
    elastic: bool = True,
    thickness: float = np.inf,
    shape: tuple[int, int] | None = None,
) -> NDArray[np.float32]:
    """How deep the gel is pressed in [m] by the object at ``T`` (4, 4): (h, w) over the window.

    Parameters
    ----------
    elastic : the gel sinks beside the contact too
    thickness : of an elastic gel [m]: a thin one hardly sinks beside the contact
    shape : (h, w) of the result, the image's own by default
    """
    h, w = shape or space.sensor.image_size_px[::-1]
    if not elastic:
        height = space.caster.contact(space.sensor, T, (h, w)).height
        assert height is not None
        return height
    depth, pitch, margin = _around(space, T, (h, w))
    gel, window = _where_gel(depth, margin, space.sensor.max_penetration)
    return elastic_contact(gel, pitch, thickness)[1][window]


def _around(
    space: ContactSpace, T: ArrayLike, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], tuple[float, float], tuple[int, int]]:
    """Depth [m] of the object at ``T`` (4, 4) below the membrane, on a grid that goes beyond the window of ``shape`` (h, w); its
    pitch [m]; and by how many (rows, columns) it does, each side."""
    sensor, (h, w) = space.sensor, shape
    # the membrane is solved as flat: its bulge is shallow over the width of a contact
    my, mx = round(MARGIN * h), round(MARGIN * w)
    size = (w + 2 * mx, h + 2 * my)
    pitch = (2 * sensor.half_window[0] / w, 2 * sensor.half_window[1] / h)
    wide = replace(sensor, image_size_px=size, pixel_pitch=pitch, membrane_radius=0.0)
    x, y = wide.pixel_centres()
    rays = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    depth = space.caster.ray_depths(sensor, np.asarray(T, float)[None], rays)[0].reshape(len(y), len(x))
    return depth, pitch, (my, mx)


def draw_noise(noise: Noise, rng: np.random.Generator) -> Noise:
    """Noise no stronger than ``noise``, its strength and its number of specks drawn uniformly: for learning from."""
    return replace(noise, outline_rms=noise.outline_rms * rng.random(), specks=int(rng.integers(noise.specks + 1)))


def spoilt(mask: NDArray[np.bool_], space: ContactSpace, noise: Noise, rng: np.random.Generator) -> NDArray[np.bool_]:
    """``mask`` (h, w) over the window with sensor noise."""
    h, w = mask.shape
    pitch = 2 * space.sensor.half_window / (w, h)
    return perturb(mask, (float(pitch[0]), float(pitch[1])), noise, rng)


def elastic_in_window(
    depth: NDArray, pitch: tuple[float, float], margin: tuple[int, int], deepest: float
) -> NDArray[np.bool_]:
    """The elastic contact in a window, of a depth field [m] that reaches ``margin`` (rows, columns) beyond it each side, without
    contact where the object is deeper than ``deepest`` [m]."""
    gel, window = _where_gel(depth, margin, deepest)
    return elastic_mask(gel, pitch)[window]


def _where_gel(depth: NDArray, margin: tuple[int, int], deepest: float) -> tuple[NDArray, tuple[slice, ...]]:
    """``depth`` where there is gel, -inf elsewhere, and the window in it.

    Beside the window an object may reach far below the membrane, into the housing: where it is deeper than ``deepest``
    there, the gel has ended.
    """
    window = tuple(slice(m, n - m) for m, n in zip(margin, depth.shape, strict=True))
    outside = np.ones(depth.shape, bool)
    outside[window] = False
    return np.where(outside & (depth > deepest), -np.inf, depth), window
