"""Object identification: scenes of one to three touches of each of several objects, localized on all of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from geomtact.errors import NoPoseAgreesError
from geomtact.evaluation import SimultaneousTouches, share_with_interval, simultaneous_touches
from geomtact.identification import identify
from geomtact.localizer import Localizer
from geomtact.sensing.noise import Noise

MOST = 3  # touches


@dataclass(frozen=True)
class Told:
    """The probabilities of one scene.

    Attributes
    ----------
    scene, touches : which of the object's scenes, and from how many of its touches
    log_probability : of each object, by its name; -inf where no pose agrees with all touches
    unlike : by object's name, whether the contacts were reported as unlike it
    """

    scene: int
    touches: int
    log_probability: dict[str, float]
    unlike: dict[str, bool]


def identify_scenes(
    own: Localizer, all_parts: Sequence[Localizer], n: int, seed: int, noise: Noise, effort: str, first: int = 0
) -> Iterator[list[Told]]:
    """Scenes ``first`` to ``n`` of the part of ``own``, rigid and elastic in turn, each from one to three touches."""
    scenes = simultaneous_touches(own.space, n, MOST, seed, noise)
    for number, scene in enumerate(islice(scenes, first, None), first):
        yield [_told(all_parts, scene, number, touches, seed, effort) for touches in range(1, MOST + 1)]


def _told(
    parts: Sequence[Localizer], scene: SimultaneousTouches, number: int, touches: int, seed: int, effort: str
) -> Told:
    images = [touch.mask for touch in scene.touches[:touches]]
    options: dict[str, Any] = {
        "kind": "mask",
        "T_world_sensor": scene.T_world_sensor[:touches],
        "effort": effort,
        "seed": seed,
    }
    names = [part.mesh.name for part in parts]
    try:
        found = {each.name: each for each in identify(parts, images, **options).candidates}
    except NoPoseAgreesError:  # of no object
        return Told(number, touches, dict.fromkeys(names, -math.log(len(names))), dict.fromkeys(names, True))
    with np.errstate(divide="ignore"):
        log_probability = {name: float(np.log(found[name].probability)) for name in names}
    return Told(number, touches, log_probability, {name: found[name].is_outlier for name in names})


def summarise(told: Mapping[str, Sequence[Told]]) -> list[dict[str, Any]]:
    """Figures for each number of touches over all objects, ``told`` by the name of the true one.

    ``right``: the share of scenes whose object is the most probable, and ``claimed``, its mean probability;
    ``probability_median`` and ``log_probability_mean`` [nats] of what the true object is given. ``foreign``: the share reported
    as unlike all objects where the true one is not among them; ``alarmed``, where it is. With 95 % intervals.
    """
    out = []
    for touches in range(1, MOST + 1):
        cases = [(name, each) for name, some in told.items() for each in some if each.touches == touches]
        log_probability = np.array([each.log_probability[name] for name, each in cases])
        right = [max(each.log_probability, key=each.log_probability.__getitem__) == name for name, each in cases]
        foreign = [all(unlike for part, unlike in each.unlike.items() if part != name) for name, each in cases]
        alarmed = [all(each.unlike.values()) for _, each in cases]
        figures: dict[str, Any] = {"touches": touches, "n": len(cases)}
        for key, which in (("right", right), ("foreign", foreign), ("alarmed", alarmed)):
            figures[key] = share_with_interval(sum(which), len(which))
        figures["probability_median"] = float(np.median(np.exp(log_probability)))
        figures["log_probability_mean"] = float(log_probability.mean())
        most = np.exp([max(each.log_probability.values()) for _, each in cases])
        figures["claimed"] = float(most.mean())
        sure = most > 0.95
        figures["sure_and_wrong"] = float(np.mean(sure & ~np.array(right)))
        out.append(figures)
    return out
