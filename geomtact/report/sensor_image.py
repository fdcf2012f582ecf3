"""Each sensor's image with its contact, and the contact simulated with the object at another pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from geomtact.se3 import Array, inverse
from geomtact.sensing.contact import Contact
from geomtact.sensing.reading import Observation
from geomtact.sensing.sensor import Sensor

if TYPE_CHECKING:
    from geomtact.inference.posterior import Posterior
    from geomtact.localizer import Localizer


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
    observation: Observation
    simulate: Callable[[Array], Contact]
    name: str = ""

    def at(self, T_frame_object: Array) -> Contact:
        """The contact simulated with the object at ``T_frame_object`` (4, 4)."""
        return self.simulate(inverse(self.T_frame_sensor) @ T_frame_object)


def sensor_images(posterior: Posterior, localizer: Localizer) -> list[SensorImage]:
    """The images of ``posterior``, which ``localizer`` made, in the order in which they were given."""
    views = posterior.provenance.views
    each = localizer.by_sensor if localizer.others else [localizer] * len(views)
    return [
        SensorImage(one.sensor, view.T_frame_sensor, observation, one.simulate, f"sensor {n}" if len(views) > 1 else "")
        for n, (one, view, observation) in enumerate(zip(each, views, posterior.observations, strict=True), 1)
    ]
