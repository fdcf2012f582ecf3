"""Which of several parts is it? By how likely each makes what the sensors show."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from geomtact.errors import NoPoseAgreesError, UsageError
from geomtact.inference.posterior import Posterior
from geomtact.inference.refine_together import UNLIKE
from geomtact.se3 import Array

if TYPE_CHECKING:
    from geomtact.inference.localizer import Localizer

# nats a contact that the likeliest pose of the right part falls short by, of several: 5 % of 22 scenes of seed 77 did by more
_MISFIT = 4.6
# what evidence of the moments is worth between parts, since a density fitted to a part's own touches is too sure of others':
# chosen on 600 touches of ten parts, seed 7777
_OF_MOMENTS = 0.25


@dataclass(frozen=True)
class Candidate:
    """One of the parts that it may be.

    Attributes
    ----------
    name : of the part
    probability : that it is this one, of those given: evidence of moments counts by a quarter, of pixels in full
    log_evidence : of what is shown, if it is; -inf where no pose agrees with all sensors
    unlike : whether hardly any touch of this part is so unlikely, or no pose explains all contacts
    """

    name: str
    probability: float
    log_evidence: float
    unlike: bool


@dataclass(frozen=True, eq=False)
class Identification:
    """The part, and its pose.

    Attributes
    ----------
    candidates : the most probable first
    localizer, posterior : of the most probable part
    """

    candidates: list[Candidate]
    localizer: Localizer
    posterior: Posterior

    @property
    def foreign(self) -> bool:
        """Whether what is shown is unlike all of the parts."""
        return all(candidate.unlike for candidate in self.candidates)


def identify(
    localizers: Iterable[Localizer], image: Any, weights: Sequence[float] | None = None, **options: Any
) -> Identification:
    """The probabilities of parts, and the pose of the most probable, given what one sensor shows, or several.

    Parameters
    ----------
    localizers : one a part, all prepared for the same sensors; of a generator, the best so far is held and one other
    image : as of ``Localizer.localize``
    weights : (n,) how probable each part is beforehand, up to a factor; all alike by default
    options : of ``Localizer.localize``; a ``prior`` would be of each part's own frame

    Raises
    ------
    UsageError
        There is no list of parts, or not one weight for each; or none with a weight could show this.
    NoPoseAgreesError
        Of no part.
    """
    told: list[tuple[str, float, bool]] = []  # name, evidence, unlike
    merits: list[float] = []
    best: tuple[float, Localizer, Posterior] | None = None
    known = None if weights is None else _log_weights(weights)
    if not isinstance(localizers, Iterable):
        raise UsageError(
            f"identify: expected a localizer for each part, got {type(localizers).__name__}; give a list of them"
        )
    for i, localizer in enumerate(localizers):
        if known is not None and i >= len(known):
            raise UsageError(f"identify: expected a weight for each part, got {len(known)} for more")
        try:
            posterior = localizer.localize(image, **options)
        except NoPoseAgreesError as error:
            told.append((localizer.mesh.name, -np.inf, True))
            merits.append(-np.inf)
            last_error = error
            continue
        told.append((localizer.mesh.name, posterior.log_evidence, _is_unlike(posterior)))
        merits.append(_worth(posterior) * posterior.log_evidence + (0.0 if known is None else float(known[i])))
        if best is None or merits[-1] > best[0]:
            best = merits[-1], localizer, posterior
    if not told:
        raise UsageError("identify: expected parts to choose from, got none")
    if known is not None and len(known) != len(told):
        raise UsageError(f"identify: expected a weight for each of {len(told)} parts, got {len(known)}")
    if best is None:
        raise last_error
    if best[0] == -np.inf:
        raise UsageError("identify: none of the parts whose weight is above 0 can show this; give others a weight")
    probability = np.exp(merits - np.logaddexp.reduce(merits))
    order = np.argsort(-probability, kind="stable")
    candidates = [Candidate(told[i][0], float(probability[i]), *told[i][1:]) for i in order]
    return Identification(candidates, best[1], best[2])


def _log_weights(weights: Sequence[float]) -> Array:
    given = np.asarray(weights, float)
    if given.ndim != 1 or not np.isfinite(given).all() or (given < 0).any() or not given.sum() > 0:
        raise UsageError(f"identify: expected weights >= 0, one a part, got {weights}")
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(given / given.sum()))


def _worth(posterior: Posterior) -> float:
    return 1.0 if "unexplained_nats" in posterior.settings else _OF_MOMENTS


def _is_unlike(posterior: Posterior) -> bool:
    if not posterior.contact:
        return False
    told = posterior.settings
    limits = {"unexplained_nats": UNLIKE, "misfit_nats": _MISFIT}
    return told["odd"] or any(
        told.get(name, 0.0) is None or told.get(name, 0.0) > most for name, most in limits.items()
    )
