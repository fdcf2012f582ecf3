"""Which picture shows which study."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from geomtact.errors import InputError, UsageError, nearest_name

# by schema: the study's pictures by name, the first the default, each drawn by a function of its folder's plot.py
PICTURES = {
    "geomtact/adaptive/3": {"adaptive": "adaptive.draw_adaptive"},
    "geomtact/choices/2": {"costs": "choices.draw_costs", "ablations": "choices.draw_ablations"},
    "geomtact/identification/1": {"identification": "identify.draw_identification"},
    "geomtact/kitting/1": {"kitting": "kitting.draw_kitting"},
    "geomtact/next-touch-study/1": {"touches": "next_touch.draw_touches_until_sure"},
    "geomtact/registration/2": {"registration": "registration.draw_registration"},
    "geomtact/scores/2": {"scores": "scores.draw_scores"},
    "geomtact/stability/2": {"stability": "stability.draw_stability"},
    "geomtact/study/3": {"calibration": "localize.draw_answers"},
    "geomtact/thesis-table/2": {"errors": "thesis.draw_thesis"},
    "geomtact/touches/1": {"touches": "touches.draw_touches"},
    "geomtact/track/2": {"track": "track.draw_track"},
}


def draw(content: Mapping[str, Any], which: str | None = None) -> bytes:
    """A PNG of what a study's JSON holds, drawn from it alone; ``which`` of its pictures, the first by default.

    Raises
    ------
    InputError
        There is no picture of what ``content`` is.
    UsageError
        The study has no picture of that name.
    """
    pictures = PICTURES.get(str(content.get("schema")))
    if pictures is None:
        raise InputError(f"no picture is drawn of {content.get('schema')!r}; expected one of: {', '.join(PICTURES)}")
    which = which or next(iter(pictures))
    if which not in pictures:
        raise UsageError(f"no picture named {which!r}{nearest_name(which, pictures)}")
    study, function = pictures[which].split(".")
    picture: bytes = getattr(import_module(f"tools.studies.{study}.plot"), function)(content)
    return picture
