"""Which picture shows which study of ``geomtact evaluate``."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from geomtact.errors import InputError, UsageError, nearest_name

# by the study's schema: its pictures by name, each drawn by a function of a module beside this one; the first is the default
PICTURES = {
    "geomtact/choices/1": {"costs": "choices_plot.draw_costs", "modelled": "choices_plot.draw_modelled"},
    "geomtact/identification/1": {"identification": "identification_plot.draw_identification"},
    "geomtact/kitting/1": {"kitting": "kitting_plot.draw_kitting"},
    "geomtact/next-touch-study/1": {"touches": "next_touch_study_plot.draw_touches_until_sure"},
    "geomtact/registration/2": {"registration": "registration_plot.draw_registration"},
    "geomtact/scores/2": {"scores": "score_plot.draw_scores"},
    "geomtact/stability/2": {"stability": "stability_plot.draw_stability"},
    "geomtact/study/3": {"calibration": "answers_plot.draw_answers"},
    "geomtact/thesis-table/2": {"errors": "thesis_plot.draw_thesis"},
    "geomtact/touches/1": {"touches": "touches_plot.draw_touches"},
    "geomtact/track/1": {"track": "track_plot.draw_track"},
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
    module, function = pictures[which].split(".")
    picture: bytes = getattr(import_module(f"geomtact.report.{module}"), function)(content)
    return picture
