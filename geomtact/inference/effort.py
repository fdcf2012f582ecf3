"""How much is done for a touch: the named efforts, and what they stand for."""

from __future__ import annotations

from dataclasses import dataclass

from geomtact.errors import UsageError, nearest_name

RESOLVED = ("coarse", "cells", "all")


@dataclass(frozen=True)
class Effort:
    """How much is done for a touch.

    Attributes
    ----------
    resolved : what is scored: "coarse" cells of about 20 cells, "cells" (on a large grid those where the mass is), or "all"
        cells, their pixels counted too
    modes : that are refined
    thorough : whether each is refined by all registrations or by one
    outlines : whether, of one mask that is not resolved by contacts, the outline refines the modes where few enough cells are
        left (see ``refine_by_outline``); these are registered in every way, as those of several sensors or of heights by
        FilterReg
    contacts : that are cut, of one mask that is not of a known face, to resolve the pose within the cells (see
        ``inference.sampler``); all cells are not scored then
    """

    resolved: str
    modes: int
    thorough: bool = True
    outlines: bool = False
    contacts: int = 0

    def __post_init__(self) -> None:
        if self.resolved not in RESOLVED:
            raise UsageError(
                f"Effort: no way to resolve named {self.resolved!r}{nearest_name(self.resolved, RESOLVED)}"
            )
        if self.modes < 0:
            raise UsageError(f"Effort: expected 0 refined modes or more, got {self.modes}; give 0 for none")
        if self.contacts < 0:
            raise UsageError(f"Effort: expected 0 contacts or more, got {self.contacts}; give 0 for none")


EFFORTS = {
    "fast": Effort("coarse", 0),
    "balanced": Effort("cells", 5, thorough=False),
    "exact": Effort("all", 25, outlines=True, contacts=30_000),
}


def effort_of(effort: str | Effort) -> Effort:
    """The effort of that name, or itself.

    Raises
    ------
    UsageError
        No such name.
    """
    if isinstance(effort, Effort):
        return effort
    if not isinstance(effort, str):
        raise UsageError(f"effort: expected one of {', '.join(EFFORTS)}, or an Effort, got {type(effort).__name__}")
    if effort not in EFFORTS:
        raise UsageError(f"no effort named {effort!r}{nearest_name(effort, EFFORTS)}")
    return EFFORTS[effort]
