"""A sequence of frames, localized one after the other and put through the filter (thesis 8.1)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sized
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from geomtact.errors import InputError, PoseError, UsageError, nearest_name
from geomtact.inference.effort import GRID_ALONE, Effort, effort_of
from geomtact.inference.facts import Diagnostics, TrackRecord
from geomtact.inference.filter import FRAME_POWER, UNIFORM_SHARE, Counts, Filter, Resolve
from geomtact.inference.motion import Motion, UniformBall
from geomtact.inference.motion_kernel import Mixture, MotionKernel
from geomtact.inference.posterior import Posterior
from geomtact.inference.preparation import PreparedObject
from geomtact.inference.prior import opened, prior_log_mass, reference_of
from geomtact.inference.repeated_images import counted_once
from geomtact.inference.resolve import LogMass, resolve_touch
from geomtact.inference.single_touch import refine_modes
from geomtact.inference.views import read_views
from geomtact.se3 import Array, check_transforms

_ERRORS = ("raise", "skip")
_NO_POSE = object()
_NO_FRAMES = "frames: expected at least one image, got none; check the folder, or the generator"


def track(
    prepared: PreparedObject,
    localize: Callable[..., Posterior],
    frames: Iterable[Any],
    T_world_sensor: Any = None,
    motion: Motion | None = None,
    effort: str | Effort = "balanced",
    prior: Any = None,
    most: int | None = None,
    *,
    kind: str = "auto",
    background: Any = None,
    counts: Counts = (FRAME_POWER, None),
    fresh: float = UNIFORM_SHARE,
    on_error: str = "raise",
    seed: int = 0,
) -> Iterator[Posterior]:
    """The posterior after each frame, given all frames up to it. Each is computed when it is asked for.

    Parameters
    ----------
    prepared, localize : of the localizer
    frames : images as ``localize`` takes them, a list or a generator, such as a live camera
    T_world_sensor : (4, 4) of a sensor at rest, or one a frame (n, 4, 4), a list or a generator: the posteriors are then in the
        world frame, and where the sensor moves the object stays, but for ``motion``
    motion : of the object from one frame to the next, ``UniformBall()`` by default; the tighter it is, the more the frames
        before constrain the pose
    effort, kind, background, seed : as for ``localize``; the filter lives on the cells of the grid, and masks are resolved within
        them as single touches are, with what the frames before make of the pose as their prior
    prior : distribution before the first frame with contact, over the sensor as it stands then (see ``inference.prior``)
    most : cells that are kept from frame to frame at most, which bounds the time a frame takes; all that count by default
    counts : powers of a frame's likelihood over the cells, in its own posterior and in those of all later frames. With None for
        the latter, all earlier frames have the power ``filter.MEMORY_POWER`` together, so that frames which err alike do not
        count twice. (1, 1) is the thesis's, for frames that err independently, such as separate touches
    fresh : share of the uniform distribution that is mixed in before each frame; 0 is the thesis's filter, in
        which dropped cells stay impossible
    on_error : "raise", or "skip" a frame that cannot be read: its posterior is what the frames before expect

    Yields
    ------
    Posterior
        Where ``diagnostics.surprise_nats`` is far below 0, ``track`` warns that the object may have slipped and replaces half of
        the expectation by the uniform distribution; so it does when contact is back after frames without. A frame without
        contact has the posterior that ``localize`` gives.

    Raises
    ------
    UsageError, InputError
        At once, or with the frame they concern, counted from 1.
    """
    motion, index = motion or UniformBall(), prepared.index
    _check(frames, index.sensor.image_size_px, motion, counts, fresh, most, on_error)
    state = make_filter(prepared, motion, counts, fresh, most, seed, effort_of(effort))
    pairs = _pairs(frames, _poses(frames, T_world_sensor))
    options = {"effort": effort, "kind": kind, "background": background, "seed": seed}
    return _tracked(prepared, localize, pairs, state, prior, options, on_error == "skip")


def make_filter(
    prepared: PreparedObject,
    motion: Motion | None = None,
    counts: Counts = (FRAME_POWER, None),
    fresh: float = UNIFORM_SHARE,
    most: int | None = None,
    seed: int = 0,
    effort: Effort | None = None,
) -> Filter:
    """The filter that :func:`track` puts the posteriors of single frames through, over cells and not refined, one
    :meth:`Filter.step` a frame. Its posteriors are resolved within the cells, and their modes refined, by ``effort``."""
    within = prepared.scorer.evidence_model.moments.covariance
    kernel = MotionKernel(prepared.index, motion or UniformBall(), seed)
    resolve = _resolved_by(prepared, effort) if effort is not None and effort.contacts else None
    return Filter(kernel, within, counts, fresh, most, resolve)


def _resolved_by(prepared: PreparedObject, effort: Effort) -> Resolve:
    def resolve(posterior: Posterior, prior: Any, log_prior: LogMass, alone: Posterior) -> Posterior:
        posterior = resolve_touch(posterior, prior, log_prior, prepared.scorer, effort, alone)
        return refine_modes(posterior, prepared.mode_refiner, effort)

    return resolve


def _tracked(
    prepared: PreparedObject,
    localize: Callable[..., Posterior],
    pairs: Iterable[tuple[int, Any, Array | None]],
    state: Filter,
    prior: Any,
    options: dict[str, Any],
    skip: bool,
) -> Iterator[Posterior]:
    index, motion, made_from, expected = prepared.index, state.motion_kernel.motion, None, None
    record = TrackRecord({"kind": type(motion).__name__, **vars(motion)}, state.counts, state.fresh, state.most)
    for n, image, T in pairs:
        frame, at = ("sensor", np.eye(4)) if T is None else ("world", T)
        try:
            (view,) = read_views(image, T, prepared.sensors, options["kind"], options["background"])
            # frames are resolved after the filter's step, by the modes of its posterior
            seen = localize(view.observation, T_world_sensor=T, **options | {"effort": GRID_ALONE})
            seen = replace(
                seen,
                provenance=replace(seen.provenance, effort=options["effort"]),
                timing_ms=seen.timing_ms | {"read": view.read_ms},
            )
        except InputError as error:
            if not skip:
                raise type(error)(
                    f'frame {n}: {error}; or pass such frames over: --skip-broken, on_error="skip" in Python'
                ) from None
            seen = Posterior(
                index,
                np.zeros(0, np.int64),
                np.zeros(0),
                frame,
                at,
                contact=False,
                seed=options["seed"],
                diagnostics=Diagnostics(is_skipped=True),
                warnings=[f"frame {n} was skipped: {error}"],
            )
        if prior is not None and (seen.contact or seen.diagnostics.is_skipped):
            # the cells are those over the sensor where it stands now
            prior = opened(prior, prepared.cache_dir)
            log_mass = prior_log_mass(index, prior, at, frame)
            state.memory = Mixture(np.flatnonzero(np.isfinite(log_mass)), np.exp(log_mass[np.isfinite(log_mass)]), 0.0)
            state.prior = made_from = expected = prior
            prior = None
        if not seen.diagnostics.is_skipped:
            seen = counted_once(seen, made_from)
        posterior = state.step(replace(seen, provenance=replace(seen.provenance, track=record)))
        posterior = replace(posterior, reference=reference_of(expected, posterior))
        if posterior.contact:
            expected = posterior
        yield posterior


def _check(
    frames: Any,
    size: tuple[int, int],
    motion: Motion,
    counts: Counts,
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
    if isinstance(motion, type) or not isinstance(motion, Motion):
        raise UsageError(
            f"motion: expected a Motion, such as UniformBall or GaussianTwist, got {motion!r}; UniformBall(0.008) is 8 mm a frame"
        )
    if not all(0 <= each < np.inf for each in vars(motion).values()):
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
        raise PoseError(f"T_world_sensor: expected (4, 4), or (n, 4, 4) for n frames, got shape {poses.shape}")
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
