"""What each choice brings and what it costs: the same touches localized by one variant after another.

Every variant is the default but for one choice. All variants meet each touch in turn, so that their times may be compared.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from geomtact.contact_space.resolution import MAX_POSES
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import CALIBRATION_NOISE, simulate_depth_map
from geomtact.contact_space.touches import Touch, random_touches
from geomtact.errors import NoPoseAgreesError, UsageError, nearest_name
from geomtact.evaluation import simultaneous_touches
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.symmetry import Symmetry
from geomtact.inference.effort import EFFORTS, Effort
from geomtact.localizer import Localizer
from geomtact.progress import Progress
from geomtact.scoring.calibration import fit_calibration, simulate_touches
from geomtact.scoring.catalogue import DEFAULT_SCORER, SCORERS
from geomtact.scoring.encoder import THESIS, about
from geomtact.scoring.fitted import SEED, TOUCHES
from geomtact.se3 import Array
from geomtact.sensing.noise import CLEAN, MODERATE, Noise, smooth_field
from geomtact.sensing.sensor import Sensor
from tools.studies.common.answer import REFUSED, Answer, judged
from tools.studies.common.study import mean_with_interval
from tools.studies.kitting.fixture import upwards
from tools.studies.scores import study as scores

SCENES = ("one touch", "three sensors", "known side")
DEFAULT, _ENCODER = "balanced", "encoder"
_SENSORS = 3
_BALANCED = EFFORTS["balanced"]
_ONE, _ALL = SCENES[:1], SCENES[:2]


@dataclass(frozen=True)
class Way:
    """One variant of localizing.

    Attributes
    ----------
    choice : in what it differs from the default
    scenes : that it is evaluated on
    cone : half angle [rad] about the known contact face to which touches are restricted; None for all directions
    quotient : whether poses that look alike by symmetry count as one
    noise, elastic : of the touches that the score is calibrated on, as of ``scoring.calibration.simulate_touches``
    kind : of the image: "mask" or "height"
    """

    choice: str
    scenes: tuple[str, ...] = _ONE
    effort: Effort = _BALANCED
    scorer: str = DEFAULT_SCORER
    max_poses: int = MAX_POSES
    cone: float | None = None
    quotient: bool = True
    noise: Noise = CALIBRATION_NOISE
    elastic: bool | None = None
    kind: str = "mask"

    @property
    def prepared(self) -> tuple[Any, ...]:
        """What has to be prepared for it; variants with the same share it."""
        return self.scorer, self.max_poses, self.cone, self.quotient


WAYS = {
    DEFAULT: Way("effort", SCENES),
    "fast": Way("effort", _ALL, EFFORTS["fast"]),
    "exact": Way("effort", _ALL, EFFORTS["exact"]),
    "no mode refined": Way("modes", _ALL, replace(_BALANCED, modes=0)),
    "1 mode": Way("modes", _ALL, replace(_BALANCED, modes=1)),
    "15 modes": Way("modes", _ALL, replace(_BALANCED, modes=15)),
    "ICP too": Way("registration", effort=replace(_BALANCED, thorough=True)),
    "75k poses": Way("grid", _ALL, max_poses=75_000),
    "300k poses": Way("grid", _ALL, max_poses=300_000),
    "2.4M poses": Way("grid", _ALL, max_poses=2_400_000),
    **{name: Way("score", scorer=name) for name in SCORERS if name != DEFAULT_SCORER},
    "symmetry ignored": Way("symmetry", quotient=False),
    "heights": Way("image", kind="height"),
    "calibrated without noise": Way("calibration", noise=CLEAN),
    "calibrated without trembling": Way("calibration", noise=replace(CALIBRATION_NOISE, outline_rms=0.0)),
    "calibrated without specks": Way("calibration", noise=replace(CALIBRATION_NOISE, specks=0)),
    "calibrated without gaps": Way("calibration", noise=replace(CALIBRATION_NOISE, missing_probability=0.0)),
    "calibrated on rigid gels": Way("calibration", elastic=False),
    "within 30 degrees": Way("side", SCENES[2:], cone=np.radians(30)),
    "this side alone": Way("side", SCENES[2:], cone=0.0, max_poses=50_000),
    "this side, 1 mode": Way("side", SCENES[2:], replace(_BALANCED, modes=1), cone=0.0, max_poses=50_000),
    "this side, exact": Way("side", SCENES[2:], EFFORTS["exact"], cone=0.0, max_poses=50_000),
}

_THESIS_POSES = 150_000  # of its discretisation (6.1.2)

# what is modelled: (the variant without it, the variant with it), both of which count nats from the same uniform
MODELLED = {
    "balanced, not fast": ("fast", DEFAULT),
    "640,000 contacts and 25 modes (exact)": (DEFAULT, "exact"),
    "a mode refined": ("no mode refined", "1 mode"),
    "5 modes refined": ("1 mode", DEFAULT),
    "15 modes refined": (DEFAULT, "15 modes"),
    "ICP beside FilterReg": (DEFAULT, "ICP too"),
    "300k poses, not 75k": ("75k poses", "300k poses"),
    "1.2M poses, not 300k": ("300k poses", DEFAULT),
    "2.4M poses, not 1.2M": (DEFAULT, "2.4M poses"),
    "the network, not moments": ("moments", DEFAULT),
    "symmetry": ("symmetry ignored", DEFAULT),
    "heights, not a mask": (DEFAULT, "heights"),
    "noise, in calibrating": ("calibrated without noise", DEFAULT),
    "trembling outlines": ("calibrated without trembling", DEFAULT),
    "specks": ("calibrated without specks", DEFAULT),
    "missing patches": ("calibrated without gaps", DEFAULT),
    "elastic gels, in calibrating": ("calibrated on rigid gels", DEFAULT),
    "5 modes refined, of a known side": ("this side, 1 mode", "this side alone"),
    "exact, of a known side": ("this side alone", "this side, exact"),
}


def ways_of(weights: Sequence[Path], only: Sequence[str] = ()) -> dict[str, Way]:
    """``WAYS``, or of these the default and ``only`` those named; and one more for each file of weights that ``geomtact train``
    wrote: an encoder of another size, on the default's grid, or the thesis's network, on a grid as large as its own.

    Raises
    ------
    UsageError
        No variant has that name.
    """
    for name in only:
        if name not in WAYS:
            raise UsageError(f"no variant named {name!r}{nearest_name(name, list(WAYS))}")
    out = {name: way for name, way in WAYS.items() if not only or name in (DEFAULT, *only)}
    for path in weights:
        if about(path).get("architecture") == THESIS:
            out["the thesis's network"] = Way("score", scorer=str(path), max_poses=_THESIS_POSES)
        else:
            out[f"encoder {path.stem}"] = Way("encoder", scorer=str(path))
    return out


@dataclass(frozen=True)
class Timed(Answer):
    """An estimate, with the time [ms] that localizing took."""

    ms: float


@dataclass(frozen=True, eq=False)
class Scene:
    """Something touched: the true pose (4, 4), the masks, the sensors' poses (n, 4, 4), None in the sensor's own frame, and the
    height map [m] of a single touch."""

    T: Array
    masks: list[Any]
    T_world_sensor: Array | None = None
    height: Any = None


def scenes_of(ways: Mapping[str, Way]) -> list[str]:
    """The kinds of scenes on which some variant is evaluated beside the default."""
    compared = [way for name, way in ways.items() if name != DEFAULT] or list(ways.values())
    return [kind for kind in SCENES if any(kind in way.scenes for way in compared)]


def prepare(
    mesh: Mesh, sensor: Sensor, way: Way, cache_dir: Path, progress: Progress | None = None
) -> tuple[Localizer, float | None]:
    """The localizer of a variant, and the seconds that preparing it took; None where it was in the cache."""
    approach = None if way.cone is None else [(upwards(mesh), way.cone)]
    if not way.quotient:
        mesh = replace(mesh, symmetry=Symmetry("none", np.eye(4)[None], None, mesh.centre))
    localizer, times = scores.prepare(mesh, sensor, way.scorer, way.max_poses, cache_dir, progress, approach)
    if (way.noise, way.elastic) != (CALIBRATION_NOISE, None):
        fitted = localizer.scorer
        touches = simulate_touches(localizer.index, TOUCHES, SEED, progress, way.elastic, way.noise)
        calibration = fit_calibration(fitted.scorer, localizer.index, touches)
        localizer = replace(localizer, scorer=replace(fitted, calibration=calibration))
    steps = (times.index, times.describe, times.calibrate)
    known = [s for s in steps if s is not None]
    return localizer, sum(known) if len(known) == len(steps) else None


def make(kind: str, localizer: Localizer, n: int, seed: int) -> list[Scene]:
    """``n`` scenes of a kind, rigid and elastic in turn, with moderate noise; ``localizer`` is the default's.

    Where a height map shows contact it is off by a smooth field, as strong as the sensor's file states.
    """
    if kind == "three sensors":
        scenes = simultaneous_touches(localizer.space, n, _SENSORS, seed)
        return [Scene(s.T_world_object, [t.mask for t in s.touches], s.T_world_sensor) for s in scenes]
    space = localizer.space
    if kind == "known side":
        space = ContactSpace(localizer.mesh, localizer.sensor, [(upwards(localizer.mesh), 0.0)])
    touches = random_touches(space, n, seed, None, MODERATE)
    return [Scene(t.T_sensor_object, [t.mask], height=_height(space, t, [seed, i])) for i, t in enumerate(touches)]


def _height(space: ContactSpace, touch: Touch, seed: list[int]) -> Array:
    """The height map (H, W) [m] of a touch."""
    rng = np.random.default_rng(seed)
    height = simulate_depth_map(space, touch.T_sensor_object, touch.elastic)
    x, y = space.sensor.pixel_centres()
    off = space.sensor.height_noise * smooth_field(x, y, rng.uniform(*MODERATE.correlation), rng)
    return np.where(height > 0, np.maximum(height + off, 0), 0)


def localized(
    localizers: Mapping[str, Localizer], ways: Mapping[str, Way], scenes: Sequence[Scene], kind: str, seed: int
) -> Iterator[dict[str, Timed]]:
    """For each scene the estimate of every variant."""
    mesh = localizers[DEFAULT].mesh
    for scene in scenes:
        out = {}
        for name, localizer in localizers.items():
            way = ways[name]
            if kind not in way.scenes:
                continue
            images = scene.masks if len(scene.masks) > 1 else scene.masks[0]
            images = scene.height if way.kind == "height" else images
            T, effort = scene.T_world_sensor, way.effort
            began, posterior = time.perf_counter(), None
            with suppress(NoPoseAgreesError):
                posterior = localizer.localize(images, way.kind, None, T, effort=effort, seed=seed)
            ms = 1e3 * (time.perf_counter() - began)
            answer = REFUSED if posterior is None else judged(mesh, scene.T, posterior)
            out[name] = Timed(**asdict(answer), ms=ms)
        yield out


def summarise(answers: Mapping[str, Sequence[Timed]]) -> dict[str, dict[str, Any]]:
    """Figures of each variant on the same scenes; gains are of the truths not ruled out, times [ms]
    the 10, 50 and 90 % quantiles."""
    out = {}
    for name, some in answers.items():
        gain = np.array([a.gain for a in some])
        kept = gain[np.isfinite(gain)]
        out[name] = {
            "n": len(some),
            "gain_mean": float(kept.mean()) if len(kept) else None,
            "gain_standard_error": float(kept.std(ddof=1) / np.sqrt(len(kept))) if len(kept) > 1 else None,
            "ruled_out": float((~np.isfinite(gain)).mean()),
            "mssd_mm_median": float(np.median([a.mssd_mm for a in some])),
            "ms_quantiles": [float(q) for q in np.quantile([a.ms for a in some], [0.1, 0.5, 0.9])],
        }
    return out


def front(figures: Mapping[str, Mapping[str, Any]], what: str = "gain_mean", best: int = 1) -> list[str]:
    """The Pareto-optimal variants, the fastest first; ``best`` is 1 where more of ``what`` is better.

    Variants that rule out more truths than the default does are left out, and of gains those that count from another uniform.
    """
    out: list[str] = []
    leader = -np.inf
    known = {
        name: f
        for name, f in figures.items()
        if f[what] is not None and _comparable(figures, name, alike=what == "gain_mean")
    }
    for name in sorted(known, key=lambda each: (known[each]["ms_quantiles"][1], -best * known[each][what])):
        if best * known[name][what] > leader:
            leader = best * known[name][what]
            out.append(name)
    return out


def beaten_by(answers: Mapping[str, Sequence[Timed]], figures: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The variants that are faster than the default, and gain more even at the lower end of the paired 95 % interval."""
    own = figures[DEFAULT]["ms_quantiles"][1]
    faster = [name for name, f in figures.items() if f["ms_quantiles"][1] < own and _comparable(figures, name)]
    return [name for name in faster if adds(answers[DEFAULT], answers[name])[1] > 0]


def _comparable(figures: Mapping[str, Mapping[str, Any]], name: str, alike: bool = True) -> bool:
    """Whether a variant rules out no more truths than the default, and if ``alike`` counts gains from the same uniform."""
    same = name not in WAYS or WAYS[name].cone == WAYS[DEFAULT].cone or not alike
    return same and bool(figures[name]["ruled_out"] <= figures[DEFAULT]["ruled_out"])


def adds(without: Sequence[Answer], with_it: Sequence[Answer]) -> list[float]:
    """Mean further gain [nats], and its paired 95 % bootstrap interval, where neither rules the truth out."""
    pairs = [(a.gain, b.gain) for a, b in zip(without, with_it, strict=True)]
    more = np.array([b - a for a, b in pairs if np.isfinite(a) and np.isfinite(b)])
    return mean_with_interval(more, np.random.default_rng(0)) if len(more) else [0.0, -np.inf, np.inf]


def modelled(answers: Mapping[str, Sequence[Timed]]) -> dict[str, dict[str, Any]]:
    """The ablations [nats], of those whose two variants were evaluated; and its time as a factor."""
    out = {}
    sizes = {f"{name}, not {_ENCODER}": (_ENCODER, name) for name in answers if name.startswith("encoder ")}
    for what, (without, with_it) in (MODELLED | sizes).items():
        if without in answers and with_it in answers:
            ms = [float(np.median([a.ms for a in answers[name]])) for name in (without, with_it)]
            more = adds(answers[without], answers[with_it])
            if np.isfinite(more).all():
                out[what] = {"adds": more, "time_ratio": ms[1] / ms[0]}
    return out
