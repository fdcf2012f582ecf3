"""Each sensor's image with its contact, and the contact simulated with the object at another pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import repeat
from typing import TYPE_CHECKING, Any

import numpy as np

from geomtact.se3 import Array, inverse
from geomtact.sensing.contact import Contact
from geomtact.sensing.sensor import Sensor

if TYPE_CHECKING:
    from geomtact.inference.localizer import Localizer
    from geomtact.inference.posterior import Posterior


@dataclass(frozen=True, eq=False)
class SensorImage:
    """One sensor's image.

    Attributes
    ----------
    sensor : whose it is
    T_frame_sensor : (4, 4) in the posterior's frame
    observation : the image and the contact in it
    simulate : the contact at a pose T_sensor_object, without noise
    name : "sensor 2", empty where there is but one
    """

    sensor: Sensor
    T_frame_sensor: Array
    observation: Any
    simulate: Callable[[Array], Contact]
    name: str = ""

    def at(self, T_frame_object: Array) -> Contact:
        """The contact simulated with the object at ``T_frame_object`` (4, 4)."""
        return self.simulate(inverse(self.T_frame_sensor) @ T_frame_object)


def sensor_images(posterior: Posterior, localizer: Localizer) -> list[SensorImage]:
    """The images of ``posterior``, which ``localizer`` made, in the order in which they were given."""
    settings, seen = posterior.settings, posterior.observations
    poses = [np.asarray(T) for T in settings.get("T_world_sensor", [posterior.T_frame_sensor])]
    touched = settings.get("touched", [True])
    first = touched.index(True) if any(touched) else 0
    in_order = [*seen[1 : first + 1], *seen[:1], *seen[first + 1 :]]
    each = (localizer, *localizer.others) if localizer.others else repeat(localizer)
    return [
        SensorImage(one.sensor, T, observation, one.simulate, f"sensor {number}" if len(poses) > 1 else "")
        for number, (one, T, observation) in enumerate(zip(each, poses, in_order, strict=False), 1)
    ]
