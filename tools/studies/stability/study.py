"""Stability: what is touched, and how, made worse step by step, while the localizer is left as it was prepared.

Each sweep leads from what the localizer was made for to what breaks it. A wrong estimate is a detected failure if it
carries a warning or its first mode holds less than half; it is an undetected failure otherwise. A sweep looks for these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from geomtact.contact_space.contact_class import CLASSES
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import simulate_mask, spoilt
from geomtact.contact_space.touches import counts, penetrations
from geomtact.errors import NoPoseAgreesError
from geomtact.evaluation import coverage, simultaneous_touches
from geomtact.geometry.mesh import Mesh, coarser
from geomtact.inference.filter import has_slipped
from geomtact.localizer import Localizer
from geomtact.planning.jaw import closed_on
from geomtact.se3 import Array, exp, inverse
from geomtact.sensing.noise import MODERATE
from tools.studies.common.answer import REFUSED, Answer, judged
from tools.studies.common.study import CERTAIN
from tools.studies.stability.worlds import TRIED, World, knobbed, larger, scanned, touches
from tools.studies.track.trajectories import random_trajectory

_SENSORS = 3  # that touch at once, where the extrinsics are wrong
_FRAMES, _STEP = 12, 2e-3  # of a sequence, and how far the object creeps from one to the next [m]
_OTHERS = ("gear", "connector_plug", "bracket")


Ask = Callable[[Localizer, float, int, int, str], Iterator[Answer]]  # level, how many, seed, effort


@dataclass(frozen=True)
class Sweep:
    """One condition that gets worse.

    Attributes
    ----------
    title : what it is, with its unit
    levels : from easy to broken
    inside : those of them that the documentation promises to hold
    world : of one touch at a level; None for sweeps of several sensors or a sequence
    ask : for those, estimates at a level
    """

    title: str
    levels: tuple[float, ...]
    inside: tuple[float, ...]
    world: Callable[[World, float], World] | None = None
    ask: Ask | None = None


def _other(mesh: Mesh, number: float) -> Mesh:
    """Another bundled object, or ``mesh`` itself for 0."""
    from geomtact.geometry.mesh_file import load_mesh

    return load_mesh(_OTHERS[int(number) - 1]) if number else mesh


def _both(factor: float, pitch: tuple[float, float]) -> tuple[float, float]:
    return factor * pitch[0], factor * pitch[1]


def swept(
    localizer: Localizer,
    sweep: Sweep,
    level: float,
    n: int,
    seed: int,
    effort: str,
    as_prepared: list[Answer] | None = None,
) -> Iterator[Answer]:
    """Estimates from ``n`` touches, or scenes of several sensors, at a level of a sweep.

    Most sweeps begin where all is as the localizer was prepared for: ``as_prepared`` holds those estimates, once they are made.
    """
    if sweep.ask is not None:
        yield from sweep.ask(localizer, level, n, seed, effort)
        return
    assert sweep.world is not None
    here = World(localizer.mesh, localizer.sensor, MODERATE, penetrations(localizer.space))
    there = sweep.world(here, level)
    if there != here or as_prepared is None:
        yield from _alone(localizer, there, n, seed, effort)
    elif len(as_prepared) >= n:
        yield from as_prepared[:n]
    else:
        as_prepared.clear()
        for answer in _alone(localizer, there, n, seed, effort):
            as_prepared.append(answer)
            yield answer


def _alone(localizer: Localizer, there: World, n: int, seed: int, effort: str) -> Iterator[Answer]:
    """Estimates from single touches of another world than the localizer was prepared for."""
    for T, mask in touches(there, n, seed):
        posterior = localizer.localize(mask, "mask", effort=effort, seed=seed)
        answer = judged(localizer.mesh, T, posterior, _knowable(localizer.space, T))
        if there.mesh.name != localizer.mesh.name:  # wherever it is said to be, it is not
            answer = replace(answer, gain=-np.inf, level=1.0, mssd_mm=np.inf)
        yield answer


def _knowable(space: ContactSpace, T: Array) -> Array:
    """``T`` (4, 4), moved along z into the contact pose space where another world's contact lies outside."""
    if np.isfinite(space.penetration(T[None])[0]):
        return T
    depth = space.caster.penetration(space.sensor, T[None])[0]
    settled, ok = space.settle(T[None], np.clip(depth, 1e-6, space.sensor.max_penetration - 1e-6))
    return settled[0] if ok[0] else T


def _rigs(off: Array, localizer: Localizer, level: float, n: int, seed: int, effort: str) -> Iterator[Answer]:
    """Scenes of three sensors whose stated poses are wrong, each off at random by ``level`` times ``off`` (6,) [rad, m], but the
    first."""
    rng = np.random.default_rng([seed, 7])
    for scene in simultaneous_touches(localizer.space, n, _SENSORS, seed):
        T = scene.T_world_sensor.copy()
        T[1:] = T[1:] @ np.array([exp(level * off * rng.normal(size=6)) for _ in T[1:]])
        yield _together(localizer, scene.T_world_object, T, [touch.mask for touch in scene.touches], effort, seed)


def _jaws(localizer: Localizer, level: float, n: int, seed: int, effort: str) -> Iterator[Answer]:
    """Two sensors that close on the object from opposite sides, on lines through the first one's window ``level`` degrees
    apart: what moves the object along both lines, or about them, both constrain alike."""
    rng, space = np.random.default_rng([seed, 9]), localizer.space
    least, most = penetrations(space)
    made = 0
    for _ in range(TRIED * n):
        if made == n:
            return
        T, elastic = space.sample(1, rng, (least, most))[0][0], made % 2 == 1
        second = opposed(T, np.radians(level), rng.uniform(0, 2 * np.pi), space, rng.uniform(least, most))
        if second is None:
            continue
        poses = [T, inverse(second) @ T]
        masks = [simulate_mask(space, pose, elastic) for pose in poses]
        if all(counts(space, mask) for mask in masks):
            noisy = [spoilt(mask, space, MODERATE, rng) for mask in masks]
            yield _together(localizer, T, np.stack([np.eye(4), second]), noisy, effort, seed)
            made += 1


def opposed(T: Array, angle: float, way: float, space: ContactSpace, depth: float) -> Array | None:
    """Where (4, 4), in the first sensor's frame, a second one stops that comes from the other side of an object at ``T`` (4, 4),
    along a line that leans by ``angle`` [rad] towards the direction ``way`` [rad]; ``depth`` [m] deep. None if it misses."""
    lean = np.array([-np.sin(way), np.cos(way), 0.0]) * angle
    facing = exp(np.pad(lean, (0, 3))) @ np.diag([1.0, -1.0, -1.0, 1.0])
    stops, touches = closed_on(space, T, facing[None], depth)
    return stops[0] if touches[0] else None


def _together(localizer: Localizer, T: Array, T_world_sensor: Array, masks: list, effort: str, seed: int) -> Answer:
    """The estimate of several sensors from an object at ``T`` (4, 4)."""
    try:
        posterior = localizer.localize(masks, "mask", T_world_sensor=T_world_sensor, effort=effort, seed=seed)
    except NoPoseAgreesError:
        return REFUSED
    return judged(localizer.mesh, T, posterior)


def _sequences(localizer: Localizer, level: float, n: int, seed: int, effort: str) -> Iterator[Answer]:
    """The estimate at the last frame of sequences in which the object slips ``level`` times, at even distances; warned, if of any
    slip."""
    slips = int(level)
    at = tuple(_FRAMES * (i + 1) // (slips + 1) for i in range(slips))
    for number in range(n):
        made = random_trajectory(
            localizer.space, _FRAMES, seed * 1000 + number, _STEP, slips=at, elastic=number % 2 == 1
        )
        told = list(localizer.track(made.masks, effort=effort, kind="mask", seed=seed))
        slipped = any(has_slipped(posterior.diagnostics.surprise_nats) for posterior in told)
        yield replace(judged(localizer.mesh, made.T_sensor_object[-1], told[-1]), warned=slipped)


SWEEPS = {
    "noise": Sweep(
        "outline displaced by [mm rms]",
        (0.0, 0.1, 0.2, 0.5, 1.0),
        (0.0, 0.1, 0.2, 0.5),
        lambda w, x: replace(w, noise=replace(w.noise, outline_rms=1e-3 * x)),
    ),
    "specks": Sweep(
        "specks of dirt", (0, 2, 6, 20, 60), (0, 2, 6), lambda w, x: replace(w, noise=replace(w.noise, specks=int(x)))
    ),
    "depth": Sweep(
        "pressed in by [mm]",
        (0.1, 0.3, 0.8, 1.5, 2.5, 4.0),
        (0.3, 0.8, 1.5),
        lambda w, x: replace(
            w,
            pressed=(0.9e-3 * x, 1.1e-3 * x),
            sensor=replace(w.sensor, max_penetration=max(w.sensor.max_penetration, 1.2e-3 * x)),
        ),
    ),
    "pitch": Sweep(
        "pixels larger than said by [%]",
        (0, 1, 2, 5, 10),
        (0, 1, 2),
        lambda w, x: replace(w, sensor=replace(w.sensor, pixel_pitch=_both(1 + x / 100, w.sensor.pixel_pitch))),
    ),
    "size": Sweep(
        "part larger than its mesh by [%]", (0, 1, 2, 5), (0, 1), lambda w, x: replace(w, mesh=larger(w.mesh, x))
    ),
    "surface": Sweep(
        "surface off its mesh by [mm rms]",
        (0, 0.05, 0.1, 0.2, 0.5),
        (0, 0.05, 0.1),
        lambda w, x: replace(w, mesh=scanned(w.mesh, 1e-3 * x)),
    ),
    "faces": Sweep(
        "faces kept of the mesh [%]",
        (100, 30, 10, 3),
        (100, 30),
        lambda w, x: replace(w, mesh=coarser(w.mesh, max(4, int(len(w.mesh.faces) * x / 100)))),
    ),
    "threshold": Sweep(
        "gel feels nothing shallower than [mm]",
        (0, 0.05, 0.1, 0.2, 0.4),
        (0, 0.05),
        lambda w, x: replace(w, threshold=1e-3 * x),
    ),
    "halo": Sweep(
        "contact found where the part is above the gel by [mm]",
        (0, 0.05, 0.1, 0.2, 0.4),
        (0, 0.05, 0.1),
        lambda w, x: replace(w, threshold=-1e-3 * x),
    ),
    "area": Sweep(
        "area of contact, to twice as much [mm2]",
        (16, 8, 4, 2, 1, 0.5, 0.1),
        (16, 8, 4, 2, 1),
        lambda w, x: replace(w, area=(1e-6 * x, 2e-6 * x), pressed=(0.2 * w.pressed[0], w.pressed[1])),
    ),
    "border": Sweep(
        "outline cut off by the border, at least [%]",
        (0, 10, 25, 40),
        (0, 10, 25),
        lambda w, x: replace(w, border=(x / 100, 1.0) if x else (0.0, 0.0)),
    ),
    "kind": Sweep(
        "contact (0 any, " + ", ".join(f"{i} {kind}" for i, kind in enumerate(CLASSES, 1)) + ")",
        tuple(range(len(CLASSES) + 1)),
        tuple(range(len(CLASSES) + 1)),
        lambda w, x: replace(w, kind=CLASSES[int(x) - 1] if x else None),
    ),
    "shown": Sweep(
        "patches that the mask shows (3 or more)",
        (1, 2, 3),
        (1, 2, 3),
        lambda w, x: replace(w, shows=(x, x if x < 3 else np.inf)),
    ),
    "detail": Sweep(
        "twelve knobs that the mesh lacks, radius [mm]",
        (0, 0.25, 0.5, 1, 2, 4),
        (0, 0.25),
        lambda w, x: replace(w, mesh=knobbed(w.mesh, 1e-3 * x)),
    ),
    "rig_shift": Sweep(
        "two of three sensors off by [mm rms]",
        (0, 0.5, 1, 2, 5, 10),
        (0, 0.5),
        ask=partial(_rigs, np.array([0, 0, 0, 1, 1, 1]) * 1e-3 / np.sqrt(3)),
    ),
    "rig_turn": Sweep(
        "two of three sensors turned by [deg rms]",
        (0, 0.5, 1, 2, 5, 10),
        (0, 0.5),
        ask=partial(_rigs, np.array([1, 1, 1, 0, 0, 0]) * np.radians(1) / np.sqrt(3)),
    ),
    "jaw": Sweep(
        "two opposed sensors, apart from one line by [deg]", (90, 30, 10, 3, 0), (90, 30, 10, 3, 0), ask=_jaws
    ),
    "slips": Sweep("slips in twelve frames", (0, 1, 2, 3), (0, 1), ask=_sequences),
    "other_part": Sweep(
        "another part (1 gear, 2 plug, 3 bracket)", (0, 1, 2, 3), (0,), lambda w, x: replace(w, mesh=_other(w.mesh, x))
    ),
}


def summarise(answers: Sequence[Answer]) -> dict[str, Any]:
    """Figures of the estimates at one level.

    ``ruled_out`` is the share of truths that were given no probability; ``certain`` that of first modes which hold half or more;
    ``found_out`` the share of wrong estimates that carry a warning or hold less than half, ``alarmed`` that of right ones which
    carry a warning; both None where there are no such.
    Gain and expected gain are of the truths not ruled out. Coverage has 99 % intervals.
    """
    gain = np.array([a.gain for a in answers])
    felt, claimed = np.isfinite(gain), np.array([a.claimed for a in answers])
    wrong, right = [a for a in answers if a.wrong], [a for a in answers if not a.wrong]
    return {
        "n": len(answers),
        "gain_mean": float(gain[felt].mean()) if felt.any() else None,
        "claimed_mean": float(claimed[felt].mean()) if felt.any() else None,
        "ruled_out": float(1 - felt.mean()),
        "mssd_mm_median": float(np.median([a.mssd_mm for a in answers])),
        "wrong": len(wrong) / len(answers),
        "warned": float(np.mean([a.warned for a in answers])),
        "silent": float(np.mean([a.silent for a in answers])),
        "certain": float(np.mean([a.probability >= CERTAIN for a in answers])),
        "found_out": float(np.mean([not a.silent for a in wrong])) if wrong else None,
        "alarmed": float(np.mean([a.warned for a in right])) if right else None,
        "coverage": [asdict(c) for c in coverage([a.level for a in answers], (0.5, 0.9), 0.99)],
    }
