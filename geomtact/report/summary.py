"""A mode in plain numbers: position of the object's centre, rotation, standard deviations and observable directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from geomtact.se3 import Array, apply, hat
from geomtact.sensing.contact import Contact
from geomtact.sensing.sensor import Sensor

if TYPE_CHECKING:
    from geomtact.inference.modes import Mode
    from geomtact.inference.posterior import Posterior

# Motions of the object in the sensor frame about and along x, y and z through the contact's centre, in the order of a
# twist (rotations first).
MOTIONS = ("tilt x", "tilt y", "turn z", "shift x", "shift y", "shift z")
HEADINGS = ("mode", "probability", "centre x, y, z [mm]", "±", "rotation vector [°]", "±", "observable directions")
OBSERVABLE, UNOBSERVABLE = 0.9, 0.1  # shares of a motion from which on, and up to which, it counts as such


@dataclass(frozen=True)
class ModeSummary:
    """One mode for people.

    Attributes
    ----------
    probability : of the mode
    centre_mm : (3,) the object's centre in the posterior's frame
    centre_sd_mm : standard deviation of the centre in its least certain direction; nan where unknown
    rotvec_deg : (3,) rotation vector of the object in the posterior's frame
    rotation_sd_deg : standard deviation of the rotation about its least certain axis; nan where unknown
    observable : share (0..1) of each motion of ``MOTIONS`` that the contact constrains
    """

    probability: float
    centre_mm: Array
    centre_sd_mm: float
    rotvec_deg: Array
    rotation_sd_deg: float
    observable: dict[str, float]

    def cells(self, number: int) -> list[str]:
        """The mode as a row of a table under ``HEADINGS``."""
        return [
            str(number),
            percent(self.probability),
            _list(self.centre_mm, 2),
            _sd(self.centre_sd_mm, 2),
            _list(self.rotvec_deg, 1),
            _sd(self.rotation_sd_deg, 1),
            self.in_words(),
        ]

    def in_words(self) -> str:
        """The observable directions, e.g. ``"fixed: shift x, shift y, shift z; partly: tilt x; not: turn z"``."""
        groups: dict[str, list[str]] = {"fixed": [], "partly": [], "not": []}
        for motion, share in self.observable.items():
            how = "fixed" if share >= OBSERVABLE else "not" if share <= UNOBSERVABLE else "partly"
            groups[how].append(motion)
        if len(groups["not"]) == len(MOTIONS):
            return "unknown"  # every contact constrains at least the depth: registration did not find this mode
        if len(groups["fixed"]) == len(MOTIONS):
            return "fixed: all six motions"
        return "; ".join(f"{how}: {', '.join(motions)}" for how, motions in groups.items() if motions)


def summarise(mode: Mode, centre: ArrayLike, contact_centre: ArrayLike = (0.0, 0.0, 0.0)) -> ModeSummary:
    """Plain numbers of ``mode``.

    Parameters
    ----------
    mode : from ``Posterior.modes``
    centre : (3,) the object's centre, object frame [m]
    contact_centre : (3,) where the contact is, in the posterior's frame [m]; tilts and turns are about it
    """
    T, c = np.asarray(mode.T, float), np.asarray(centre, float)
    # T exp(xi^) moves the object's point c by R (t - c x r)
    move = np.concatenate([-hat(c), np.eye(3)], axis=1)
    return ModeSummary(
        probability=float(mode.probability),
        centre_mm=1e3 * (T[:3, :3] @ c + T[:3, 3]),
        centre_sd_mm=1e3 * _largest_sd(move @ mode.covariance @ move.T),
        rotvec_deg=np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec()),
        rotation_sd_deg=float(np.degrees(_largest_sd(np.asarray(mode.covariance)[:3, :3]))),
        observable=observable_share(mode, contact_centre),
    )


def observable_share(mode: Mode, about: ArrayLike) -> dict[str, float]:
    """Share (0..1) of each motion of ``MOTIONS`` about the point ``about`` (3,) [m] that the contact constrains.

    The unobservable motions form a subspace. It is carried from the object's origin to the point, as a long lever between
    the two would hide a lost rotation otherwise. The share of a motion is what lies outside this subspace.
    """
    R, length = mode.T[:3, :3], mode.length
    rows = np.asarray(mode.observable, float).reshape(-1, 6)
    lost = np.linalg.svd(rows)[2][len(rows) :] if len(rows) else np.eye(6)
    carried = np.zeros((6, 6))
    carried[:3, :3] = carried[3:, 3:] = R
    # a rotation about the object's origin moves the point by w x (point - origin)
    carried[3:, :3] = -hat(np.asarray(about, float) - mode.T[:3, 3]) @ R / length
    basis = np.linalg.qr(carried @ lost.T)[0]
    share = 1 - (basis**2).sum(1)
    return dict(zip(MOTIONS, np.clip(share, 0, 1).tolist(), strict=True))


def contact_centre(contact: Contact, sensor: Sensor) -> Array:
    """Centre (3,) [m] of the contact's area on the membrane, sensor frame; the window's centre without contact."""
    if not contact.mask.any():
        return np.zeros(3)
    x, y = sensor.pixel_centres(contact.mask.shape)  # type: ignore[arg-type]
    rows, columns = np.nonzero(contact.mask)
    return sensor.lift(np.array([x[columns].mean(), y[rows].mean()]))


def table(summaries: Sequence[ModeSummary]) -> list[list[str]]:
    """Rows under ``HEADINGS``, numbered from 1."""
    return [summary.cells(k + 1) for k, summary in enumerate(summaries)]


def summaries_of(posterior: Posterior, modes: Sequence[Mode]) -> list[ModeSummary]:
    """Plain numbers of ``modes``; tilts and turns are about the middle of the observed contact."""
    about = [
        apply(posterior.T_frame_sensor, contact_centre(o.contact, posterior.sensor)[None])[0]
        for o in [posterior.observation]
        if o is not None
    ]
    return [summarise(mode, posterior.mesh.centre, *about) for mode in modes]


def facts(posterior: Posterior) -> list[str]:
    """Sentences on the whole distribution: contacts and information gain."""
    if not posterior.contact:
        several = len(posterior.provenance.views) > 1
        return [f"No contact was found in {'any of the images' if several else 'the image'}."]
    gain = max(0.0, posterior.information_gain_nats)
    views = posterior.provenance.views
    empty = [str(number) for number, view in enumerate(views, 1) if not view.has_contact]
    lines = []
    if empty:
        lines.append(f"Sensor {' and '.join(empty)} has no contact: poses that would touch there are less probable.")
    methods = sorted({view.contact_method for view in views if view.contact_method})
    if methods:
        lines.append(f"Method of contact detection: {' and '.join(methods)}.")
    left = f"1 in {np.exp(min(gain, 700)):,.0f}"
    if gain >= 14:
        left = "less than 1 in a million"
    elif gain < 0.7:
        left = f"{100 * np.exp(-gain):.0f} %"
    return [
        *lines,
        f"Information gain: {gain:.1f} nats; {left} of all touching poses remains.",
    ]


def caution(modes: Sequence[ModeSummary]) -> list[str]:
    """A caution about the first mode; nothing if it holds half of the probability."""
    if not modes or modes[0].probability >= 0.5:
        return []
    return [
        f"The object is probably not at mode 1, which holds {percent(modes[0].probability)}; touch again, or give a prior."
    ]


def percent(share: float) -> str:
    """A share (0..1) in percent; a small share is not written as 0."""
    return f"{100 * share:.1f} %" if share >= 0.001 else "< 0.1 %"


def _largest_sd(covariance: Array) -> float:
    if not np.isfinite(covariance).all():
        return float("nan")
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh(covariance)[-1])))


def _list(values: Array, digits: int) -> str:
    # adding zero turns -0.0 into 0.0
    return ", ".join(f"{v:.{digits}f}" for v in values.round(digits) + 0.0)


def _sd(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "unknown"
