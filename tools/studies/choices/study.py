"""Information gain, error and time of each choice: the same touches localized by one variant after another.

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
from geomtact.contact_space.touch import simulate_depth_map
from geomtact.contact_space.touches import Touch, random_touches
from geomtact.errors import NoPoseAgreesError, UsageError, nearest_name
from geomtact.evaluation import simultaneous_touches
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.symmetry import Symmetry
from geomtact.inference.effort import EFFORTS, GRID_ALONE, Effort
from geomtact.localizer import Localizer
from geomtact.progress import Progress
from geomtact.scoring.catalogue import DEFAULT_SCORER
from geomtact.scoring.encoder import THESIS, about
from geomtact.se3 import Array
from geomtact.sensing.noise import MODERATE, smooth_field
from geomtact.sensing.sensor import Sensor
from tools.studies.common.answer import REFUSED, Answer, judged
from tools.studies.common.study import mean_with_interval
from tools.studies.kitting.fixture import upwards
from tools.studies.scores import study as scores

SCENES = ("one touch", "three sensors", "known contact face")
DEFAULT = "balanced"
_SENSORS = 3
_BALANCED = EFFORTS["balanced"]
_ONE, _ALL = SCENES[:1], SCENES[:2]


@dataclass(frozen=True)
class Variant:
    """The default but for one choice.

    Attributes
    ----------
    choice : in what it differs from the default
    scenes : that it is evaluated on
    cone : half angle [rad] about the known contact face to which touches are restricted; None for all directions
    quotient : whether poses that look alike by symmetry count as one
    kind : of the image: "mask" or "height"
    """

    choice: str
    scenes: tuple[str, ...] = _ALL
    effort: Effort = _BALANCED
    scorer: str = DEFAULT_SCORER
    max_poses: int = MAX_POSES
    cone: float | None = None
    quotient: bool = True
    kind: str = "mask"

    @property
    def prepared(self) -> tuple[Any, ...]:
        """What has to be prepared for it; variants with the same share it."""
        return self.scorer, self.max_poses, self.cone, self.quotient


_FACE = Variant("contact face", SCENES[2:], cone=0.0, max_poses=50_000)
VARIANTS = {
    DEFAULT: Variant("effort", SCENES),
    "the grid alone": Variant("effort", effort=GRID_ALONE),
    "fast": Variant("effort", effort=EFFORTS["fast"]),
    "exact": Variant("effort", effort=EFFORTS["exact"]),
    "no mode refined": Variant("modes", effort=replace(_BALANCED, modes=0)),
    "ICP too": Variant("modes", effort=replace(_BALANCED, thorough=True)),
    "75k poses": Variant("grid", max_poses=75_000),
    "1.2M poses": Variant("grid", max_poses=1_200_000),
    "the grid alone, cosine": Variant("score", _ONE, GRID_ALONE, "cosine"),
    "the grid alone, moments": Variant("score", _ONE, GRID_ALONE, "moments"),
    "symmetry ignored": Variant("symmetry", _ONE, quotient=False),
    "depth map": Variant("image", _ONE, kind="height"),
    "face to 30 degrees": Variant("contact face", SCENES[2:], cone=np.radians(30)),
    "known face": _FACE,
    "known face, the grid alone": replace(_FACE, effort=GRID_ALONE),
    "known face, exact": replace(_FACE, effort=EFFORTS["exact"]),
}

_THESIS_POSES = 150_000  # of its discretisation (6.1.2)

# what is left out, or added: (the variant without it, the variant with it), which count nats from the same uniform
ABLATIONS = {
    "contacts within the cells": ("the grid alone", DEFAULT),
    "up to 16 times the contacts": ("fast", DEFAULT),
    "4 times more, and 25 modes": (DEFAULT, "exact"),
    "modes refined": ("no mode refined", DEFAULT),
    "ICP beside FilterReg": (DEFAULT, "ICP too"),
    "300k poses, not 75k": ("75k poses", DEFAULT),
    "1.2M poses, not 300k": (DEFAULT, "1.2M poses"),
    "the network, not moments (grid alone)": ("the grid alone, moments", "the grid alone"),
    "symmetry": ("symmetry ignored", DEFAULT),
    "a depth map, not a mask": (DEFAULT, "depth map"),
    "known face: contacts within the cells": ("known face, the grid alone", "known face"),
    "known face: exact": ("known face", "known face, exact"),
}


def variants_of(weights: Sequence[Path], only: Sequence[str] = ()) -> dict[str, Variant]:
    """``VARIANTS``, or of these the default and ``only`` those named; and one more for each file of weights that
    ``geomtact train`` wrote: an encoder of another size, on the default's grid, or the thesis's network, on a grid like its own.

    Raises
    ------
    UsageError
        No variant has that name.
    """
    for name in only:
        if name not in VARIANTS:
            raise UsageError(f"no variant named {name!r}{nearest_name(name, list(VARIANTS))}")
    out = {name: variant for name, variant in VARIANTS.items() if not only or name in (DEFAULT, *only)}
    for path in weights:
        of_thesis = about(path).get("architecture") == THESIS
        name, poses = (
            ("the thesis's network", _THESIS_POSES)
            if of_thesis
            else (f"the grid alone, encoder {path.stem}", MAX_POSES)
        )
        out[name] = Variant("score", _ONE, GRID_ALONE, str(path), poses)
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


def scenes_of(variants: Mapping[str, Variant]) -> list[str]:
    """The kinds of scenes on which some variant is evaluated beside the default."""
    compared = [variant for name, variant in variants.items() if name != DEFAULT] or list(variants.values())
    return [kind for kind in SCENES if any(kind in variant.scenes for variant in compared)]


def prepare(
    mesh: Mesh, sensor: Sensor, variant: Variant, cache_dir: Path, progress: Progress | None = None
) -> tuple[Localizer, float | None]:
    """The localizer of a variant, and the seconds that preparing it took; None where it was in the cache."""
    approach = None if variant.cone is None else [(upwards(mesh), variant.cone)]
    if not variant.quotient:
        mesh = replace(mesh, symmetry=Symmetry("none", np.eye(4)[None], None, mesh.centre))
    localizer, times = scores.prepare(mesh, sensor, variant.scorer, variant.max_poses, cache_dir, progress, approach)
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
    if kind == SCENES[2]:
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
    localizers: Mapping[str, Localizer], variants: Mapping[str, Variant], scenes: Sequence[Scene], kind: str, seed: int
) -> Iterator[dict[str, Timed]]:
    """For each scene the estimate of every variant."""
    mesh = localizers[DEFAULT].mesh
    for scene in scenes:
        out = {}
        for name, localizer in localizers.items():
            variant = variants[name]
            if kind not in variant.scenes:
                continue
            images = scene.masks if len(scene.masks) > 1 else scene.masks[0]
            images = scene.height if variant.kind == "height" else images
            T, effort = scene.T_world_sensor, variant.effort
            began, posterior = time.perf_counter(), None
            with suppress(NoPoseAgreesError):
                posterior = localizer.localize(images, variant.kind, None, T, effort=effort, seed=seed)
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
    return [name for name in faster if further_gain(answers[DEFAULT], answers[name])[1] > 0]


def _comparable(figures: Mapping[str, Mapping[str, Any]], name: str, alike: bool = True) -> bool:
    """Whether a variant rules out no more truths than the default, and if ``alike`` counts gains from the same uniform."""
    same = name not in VARIANTS or VARIANTS[name].cone == VARIANTS[DEFAULT].cone or not alike
    return same and bool(figures[name]["ruled_out"] <= figures[DEFAULT]["ruled_out"])


def further_gain(without: Sequence[Answer], with_it: Sequence[Answer]) -> list[float]:
    """Mean further gain [nats], and its paired 95 % bootstrap interval, where neither rules the truth out."""
    pairs = [(a.gain, b.gain) for a, b in zip(without, with_it, strict=True)]
    more = np.array([b - a for a, b in pairs if np.isfinite(a) and np.isfinite(b)])
    return mean_with_interval(more, np.random.default_rng(0)) if len(more) else [0.0, -np.inf, np.inf]


def ablations(answers: Mapping[str, Sequence[Timed]]) -> dict[str, dict[str, Any]]:
    """The ablations [nats], of those whose two variants were evaluated; and its time as a factor."""
    out = {}
    for what, (without, with_it) in ABLATIONS.items():
        if without in answers and with_it in answers:
            ms = [float(np.median([a.ms for a in answers[name]])) for name in (without, with_it)]
            more = further_gain(answers[without], answers[with_it])
            if np.isfinite(more).all():
                out[what] = {"gain": more, "time_ratio": ms[1] / ms[0]}
    return out
