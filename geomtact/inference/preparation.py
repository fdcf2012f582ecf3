"""The contact index and the calibrated score of an object on each of its sensors (thesis 6.1.1 to 6.1.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from geomtact.contact_space.index import Index
from geomtact.contact_space.resolution import MAX_POSES
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.store import default_cache_dir, open_index
from geomtact.errors import UsageError
from geomtact.geometry.approach import Approach
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.mesh_file import load_mesh
from geomtact.inference.mode_refiner import ModeRefiner
from geomtact.inference.pickled import reopened
from geomtact.progress import Progress
from geomtact.scoring.fitted import FittedScorer, fitted_scorer
from geomtact.se3 import check_pose
from geomtact.sensing.contact import Contact
from geomtact.sensing.sensor import Sensor


@dataclass(frozen=True, eq=False)
class PreparedObject:
    """One object on one sensor, or on several, ready to be localized.

    Attributes
    ----------
    index : every touch of the object on the sensor, simulated beforehand
    scorer : the calibrated score that compares a contact with them
    max_poses, cache_dir : as given to ``Localizer.prepare``
    others : the same object on the second and further sensors, where they are not all alike
    """

    index: Index
    scorer: FittedScorer
    max_poses: int = MAX_POSES
    cache_dir: str | Path | None = None
    others: tuple[Self, ...] = ()

    def simulate(self, T_sensor_object: Any) -> Contact:
        """Mask and depth map at a pose (4, 4), object to sensor in metres, without noise (thesis 6.1.3), or PoseError."""
        return self.space.caster.contact(self.sensor, check_pose(T_sensor_object, "T_sensor_object"))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled by reference to its index and score in the cache, which a process reads once."""
        parts = tuple(getattr(self, field.name) for field in fields(self))
        if self.index.folder is None:
            return type(self), parts
        return reopened, (type(self), self.index, self.scorer.name, self.scorer.calibration, *parts[2:])

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.mesh.name} on {self.sensor.name}, {len(self.index):,} poses, {self.scorer.name})"

    @property
    def mesh(self) -> Mesh:
        return self.index.mesh

    @property
    def sensor(self) -> Sensor:
        return self.index.sensor

    @property
    def by_sensor(self) -> list[Self]:
        """This one and the others: one for each image, or one for all."""
        return [self, *self.others]

    @property
    def sensors(self) -> list[Sensor]:
        """One for each image, or one for all."""
        return [one.index.sensor for one in self.by_sensor]

    @property
    def space(self) -> ContactSpace:
        """The object's contact pose space, undiscretised."""
        return self.index.space

    @cached_property
    def mode_refiner(self) -> ModeRefiner:
        return ModeRefiner(self.index.space)


def prepare_each(
    mesh: str | Path | Mesh,
    unit: str | None,
    sensor: str | Path | Sensor | Sequence[str | Path | Sensor],
    approach: Approach | None,
    scorer: str,
    max_poses: int,
    cache_dir: str | Path | None,
    progress: Progress | None,
) -> list[tuple[Index, FittedScorer]]:
    """One index and score for each sensor; sensors of the same geometry share theirs. Parameters as of ``Localizer.prepare``."""
    if not isinstance(max_poses, int | np.integer):
        raise UsageError(f"max_poses: expected a whole number, got {max_poses!r}")
    sensors = [Sensor.load(each) for each in ([sensor] if isinstance(sensor, str | Path | Sensor) else sensor)]
    if not sensors:
        raise UsageError("prepare: expected a sensor for every image, got an empty list")
    folder = Path(cache_dir) if cache_dir is not None else default_cache_dir()
    prepared: dict[Sensor, tuple[Index, FittedScorer]] = {}
    for each in dict.fromkeys(sensors):
        index = open_index(load_mesh(mesh, unit, sensor=each), each, approach, max_poses, cache_dir, progress)
        prepared[each] = index, fitted_scorer(scorer, index, folder / index.key, progress)
    return [(_read_as(prepared[each][0], each), prepared[each][1]) for each in sensors]


def _read_as(index: Index, sensor: Sensor) -> Index:
    """``index`` for another sensor of the same geometry, whose images are read differently."""
    if all(getattr(index.sensor, f.name) == getattr(sensor, f.name) for f in fields(Sensor) if f.name != "note"):
        return index
    return replace(index, sensor=sensor)
