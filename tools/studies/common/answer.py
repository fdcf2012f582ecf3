"""The estimate of one touch, or of one scene, compared with the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomtact.evaluation import assess
from geomtact.geometry.distance import PoseDistance
from geomtact.geometry.mesh import Mesh
from geomtact.inference.posterior import Posterior
from geomtact.se3 import Array
from tools.studies.common.study import CERTAIN, WRONG_MM


@dataclass(frozen=True)
class Answer:
    """The estimate of one touch, or one scene. Lengths in millimetres, information in nats.

    Attributes
    ----------
    gain : log density at the true pose; -inf where it was given no probability
    claimed : minus the entropy
    level : credible level of the true pose
    mssd_mm, probability : of the first mode; inf and 0 where there is none
    warned : whether a warning came with it; an error in place of an estimate counts as one
    """

    gain: float
    claimed: float
    level: float
    mssd_mm: float
    probability: float
    warned: bool

    @property
    def wrong(self) -> bool:
        return self.mssd_mm > WRONG_MM

    @property
    def silent(self) -> bool:
        """Wrong, without a sign of it: an undetected failure."""
        return self.wrong and self.probability >= CERTAIN and not self.warned


REFUSED = Answer(-np.inf, 0.0, 1.0, np.inf, 0.0, True)  # an error took the estimate's place


def judged(mesh: Mesh, T: Array, posterior: Posterior, nearest: Array | None = None) -> Answer:
    """A posterior held against the truth ``T`` (4, 4); errors are modulo the symmetry of ``mesh``.

    Where ``T`` lies outside the contact pose space, its density and level are those of ``nearest`` (4, 4), a pose inside.
    """
    found = assess(posterior, T, 1, PoseDistance(mesh), nearest)
    return Answer(
        gain=found.gain,
        claimed=found.expected_gain,
        level=found.level,
        mssd_mm=float(1e3 * found.mssd.min(initial=np.inf)),
        probability=found.probability,
        warned=bool(posterior.warnings),
    )
