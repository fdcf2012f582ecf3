"""The provenance and the diagnostics of a posterior, typed so that no decision reads a text or a key."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from geomtact.inference.effort import Effort
from geomtact.se3 import Array

# Where the likeliest pose leaves more of each of several contacts unexplained (see ``Diagnostics``), the poses that were found
# have half of the probability, and poor agreement is reported. 2 of 26 simulated scenes with two and three masks exceed it; with
# eight contacts of a jaw, of which each alone fits its noise best, right poses leave 6 to 15. Contacts that are found badly in
# images leave more: in 12 of 20 triplets, seed 5.
UNEXPLAINED_NATS = 20.0


@dataclass(frozen=True)
class Diagnostics:
    """Signs of trouble in a posterior.

    Attributes
    ----------
    is_outlier : whether a contact is out of distribution: no simulated touch of the object resembles it
    disagrees : whether the other sensors, or the prior, contradict a sensor's image
    unexplained_nats : per contact, by how much the likeliest pose, with sensors where they are said to be, explains less than
        the best pose of each sensor alone; inf where no pose suits all; None for one sensor, and where no contacts were cut
    misfit_nats : by how much the contacts that are cut at the likeliest pose miss the masks, and their depths those that were
        measured, for every 15 mm of outline; inf where no pose suits all, None where no contacts were cut
    evidence_of : what ``log_evidence`` compares: the "moments" of a contact, or "contacts" that are cut at poses
    settled_power : largest power of the likelihood that the contacts settle within the cells, 1 the sharpest, 0 none; None
        where the posterior is that of the cells
    frame : number of the frame in a sequence, from 1; None outside of one
    surprise_nats : log of how likely the posterior of the frame before made this frame, relative to chance; None where
        nothing was compared
    is_skipped : whether the frame's image could not be read
    """

    is_outlier: bool = False
    disagrees: bool = False
    unexplained_nats: float | None = None
    misfit_nats: float | None = None
    evidence_of: str = "moments"
    settled_power: float | None = None
    frame: int | None = None
    surprise_nats: float | None = None
    is_skipped: bool = False


@dataclass(frozen=True, eq=False)
class ViewRecord:
    """What was resolved for one image.

    Attributes
    ----------
    T_frame_sensor : (4, 4) of the sensor in the posterior's frame
    kind : "mask", "height" or "reading"
    contact_method : by which the contact was found in a reading; None for other kinds
    has_height : whether depths were measured
    has_contact : whether the image shows contact
    digest : of an image with contact; None for one without
    """

    T_frame_sensor: Array
    kind: str
    contact_method: str | None
    has_height: bool
    has_contact: bool
    digest: str | None


@dataclass(frozen=True, eq=False)
class TrackRecord:
    """How frames of a sequence were combined: the arguments of ``track``, and the motion with its kind."""

    motion: Mapping[str, float | str]
    counts: tuple[float, float | None]
    fresh: float
    most: int | None


@dataclass(frozen=True, eq=False)
class Provenance:
    """What a posterior was made from.

    Attributes
    ----------
    effort, scorer, max_poses : as resolved by ``localize`` and ``prepare``
    scored_by, temperature, floor : the score that was used, and its calibration
    views : one for each image, in the order given
    earlier_images : digests of images with contact that the prior or the frames before were made from
    lacks_prior : whether the prior, and other sensors without contact, were left out when it was saved
    track : how frames were combined, in a sequence
    """

    effort: str | Effort = "balanced"
    scorer: str = ""
    max_poses: int | None = None
    scored_by: str | None = None
    temperature: float | None = None
    floor: float | None = None
    views: tuple[ViewRecord, ...] = ()
    earlier_images: tuple[str, ...] = ()
    lacks_prior: bool = False
    track: TrackRecord | None = None

    @property
    def base(self) -> int:
        """Number of the view whose cells the posterior lives on: the first with contact."""
        return next((i for i, view in enumerate(self.views) if view.has_contact), 0)

    @property
    def images(self) -> tuple[str, ...]:
        """Digests of all images with contact, its own first."""
        own = (view.digest for view in self.views if view.digest is not None)
        return tuple(dict.fromkeys([*own, *self.earlier_images]))

    def without_prior(self) -> Provenance:
        """As it is saved where the prior cannot be."""
        return replace(self, earlier_images=(), lacks_prior=True)

    def to_json(self) -> dict[str, Any]:
        """In types of JSON."""
        views = [asdict(view) | {"T_frame_sensor": view.T_frame_sensor.tolist()} for view in self.views]
        return asdict(replace(self, views=())) | {"views": views}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Provenance:
        """Inverse of :meth:`to_json`.

        Raises
        ------
        KeyError, TypeError, ValueError, UsageError
            It was not written by :meth:`to_json`.
        """
        effort, track = content["effort"], content["track"]
        views = (ViewRecord(**view | {"T_frame_sensor": np.array(view["T_frame_sensor"])}) for view in content["views"])
        resolved = {
            "effort": Effort(**effort) if isinstance(effort, dict) else effort,
            "views": tuple(views),
            "earlier_images": tuple(content["earlier_images"]),
            "track": None if track is None else TrackRecord(**track | {"counts": tuple(track["counts"])}),
        }
        return cls(**{**content, **resolved})
