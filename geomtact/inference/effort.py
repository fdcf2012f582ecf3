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
    contacts : that the largest attempt to resolve the pose within the cells of the grid may cut, on all sensors together. Of one
        sensor, half as many more weigh the modes, and the density at poses takes more. 0 leaves the cells as they are
    thorough : whether each mode is refined by all registrations or by one
    first : contacts that the first attempt cuts on each sensor, which settles most touches. None is a twentieth of ``contacts``,
        10,000 at least, or a quarter of that on each of several sensors
    """

    modes: int
    contacts: int = 0
    thorough: bool = True
    first: int | None = None

    def __post_init__(self) -> None:
        if self.modes < 0:
            raise UsageError(f"Effort: expected 0 refined modes or more, got {self.modes}; give 0 for none")
        if self.contacts < 0:
            raise UsageError(f"Effort: expected 0 contacts or more, got {self.contacts}; give 0 for none")
        if self.first is not None and self.first < 1:
            raise UsageError(f"Effort: expected 1 contact or more in the first attempt, got {self.first}; give 10,000")

    def attempts(self, sensors: int) -> list[int]:
        """Contacts that each attempt cuts on each of some ``sensors``: the first one, and each after it four times as many."""
        usual = max(LEAST_CONTACTS, self.contacts // _SHARE) // (_FEWER_OF_SEVERAL if sensors > 1 else 1)
        out = [self.first or usual]
        while _MORE * out[-1] * sensors <= self.contacts:
            out.append(_MORE * out[-1])
        return out


# Of an attempt on one sensor: with fewer, the evidence is mostly found too small, by more than a nat (docs/adaptive.md).
LEAST_CONTACTS = 10_000
_SHARE = 20  # the first attempt cuts one of so many of all contacts
# times as few on each of several sensors, where registration finds the modes: mean gains of 14 to 20 scenes of four objects
# differ by -1.1 to 1.7 nats from those with as many (seeds 4711 and 5151). Evidences of objects are far too small then
# (``identification``).
_FEWER_OF_SEVERAL = 4
_MORE = 4  # times as many contacts are cut in each attempt after the first
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
