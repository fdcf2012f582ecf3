"""How much is done for a touch: the named efforts, and what they stand for."""

from __future__ import annotations

from dataclasses import dataclass

from geomtact.errors import UsageError, nearest_name


@dataclass(frozen=True)
class Effort:
    """How much is done for a touch.

    Attributes
    ----------
    modes : that are refined, where the pose is resolved within the cells
    contacts : that the largest attempt to resolve the pose within the cells of the grid may cut, on all sensors together. The
        first one has a twentieth of them, 10,000 at least, or a quarter of that on each of several sensors, and settles most
        touches (see ``inference.two_runs``). Of one sensor, half as many more weigh the modes, and the density at poses takes
        more. 0 leaves the cells as they are
    thorough : whether each mode is refined by all registrations or by one
    """

    modes: int
    contacts: int = 0
    thorough: bool = True

    def __post_init__(self) -> None:
        if self.modes < 0:
            raise UsageError(f"Effort: expected 0 refined modes or more, got {self.modes}; give 0 for none")
        if self.contacts < 0:
            raise UsageError(f"Effort: expected 0 contacts or more, got {self.contacts}; give 0 for none")


# Of an attempt on one sensor: with fewer, the evidence is mostly found too small, by more than a nat (docs/adaptive.md).
LEAST_CONTACTS = 10_000
GRID_ALONE = Effort(0)  # for studies, and for what lives on the cells of the grid
EFFORTS = {
    "fast": Effort(0, LEAST_CONTACTS),
    "balanced": Effort(5, 200_000, thorough=False),
    "exact": Effort(25, 800_000),
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
