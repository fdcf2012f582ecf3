"""From a mesh and a tactile image to the distribution of the part's pose: the thesis's method, a call a step."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from geomtact.contact_space.index import Index
from geomtact.contact_space.resolution import MAX_POSES
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.store import default_cache_dir, open_index
from geomtact.errors import UsageError, nearest_name
from geomtact.geometry.approach import Approach
from geomtact.geometry.mesh import Mesh, load_mesh
from geomtact.inference.posterior import Posterior
from geomtact.inference.prior import prior_log_density, prior_log_mass
from geomtact.inference.refine import Refinery
from geomtact.progress import Progress
from geomtact.scoring.calibration import Calibration, posterior_log_prob
from geomtact.scoring.catalogue import DEFAULT_SCORER
from geomtact.scoring.fitted import FittedScorer, fitted_scorer
from geomtact.se3 import check_transforms
from geomtact.sensing.contact import Contact
from geomtact.sensing.reading import read_observation
from geomtact.sensing.sensor import Sensor


@dataclass(frozen=True)
class Effort:
    """How much is done for a touch.

    Attributes
    ----------
    resolved : what is scored: "blocks" of about 20 cells, "cells" (on a large grid those where the mass is), or "all"
        cells, their pixels counted too
    modes : that are refined
    thorough : whether each is refined by all registrations or by one
    """

    resolved: str
    modes: int
    thorough: bool = True


EFFORTS = {"fast": Effort("blocks", 0), "balanced": Effort("cells", 5, thorough=False), "exact": Effort("all", 25)}


@dataclass(frozen=True, eq=False)
class Localizer:
    """Localizes one object on one sensor.

    Attributes
    ----------
    index : every touch of the object on the sensor, simulated beforehand
    scorer : the calibrated score that compares a contact with them
    max_poses, cache_dir : as given to :meth:`prepare`
    """

    index: Index
    scorer: FittedScorer
    max_poses: int = MAX_POSES
    cache_dir: str | Path | None = None

    @classmethod
    def prepare(
        cls,
        mesh: str | Path | Mesh,
        unit: str | None = None,
        sensor: str | Path | Sensor = "gelslim",
        approach: Approach | None = None,
        *,
        scorer: str = DEFAULT_SCORER,
        max_poses: int = MAX_POSES,
        cache_dir: str | Path | None = None,
        progress: Progress | None = None,
    ) -> Localizer:
        """Simulate all touches of an object (thesis 6.1.1 to 6.1.3), or read them from the cache.

        Parameters
        ----------
        mesh : name of a bundled part, path of a mesh file, or a Mesh
        unit : "mm", "cm", "m" or "inch"; needed for files that state none
        sensor : name of a bundled sensor, path of a TOML file, or a Sensor
        approach : [(direction (3,), half angle)]: only touches whose direction from the object towards the sensor, in
            the object frame, lies within the angle [rad] of one of these; 0 means exactly that face
        scorer : how contacts are compared, one of ``geomtact.scoring.catalogue.SCORERS``, or weights (.safetensors)
        max_poses : about how many poses the grid may have
        cache_dir : folder of the index cache; by default ``$GEOMTACT_CACHE`` or the user's cache folder
        progress : called with the share done (0 to 1) and what is being done

        Raises
        ------
        MeshError, SensorError, UsageError, CacheError
        """
        sensor = Sensor.load(sensor)
        part = load_mesh(mesh, unit, sensor=sensor)
        index = open_index(part, sensor, approach, max_poses, cache_dir, progress)
        folder = Path(cache_dir) if cache_dir is not None else default_cache_dir()
        return cls(index, fitted_scorer(scorer, index, folder / index.key, progress), max_poses, cache_dir)

    def localize(
        self,
        image: Any,
        kind: str = "auto",
        background: Any = None,
        T_world_sensor: Any = None,
        prior: Any = None,
        effort: str = "balanced",
        seed: int = 0,
    ) -> Posterior:
        """The distribution of the object's pose, given what the sensor shows (thesis 6.1 and 6.3).

        Parameters
        ----------
        image : path or array: a mask, a height map [m] or an RGB reading (see ``sensing.reading``)
        kind : "auto", "mask", "height" or "reading"
        background : a reading without contact, for readings
        T_world_sensor : (4, 4), or [(4, 4)] for one image: the posterior is then in the world frame
        prior : None, a Posterior, its path, a pair (poses, log weights) or a log density (see ``inference.prior``)
        effort : "fast" (the grid's blocks, nothing refined), "balanced" (its cells, five refined modes) or "exact" (every
            cell, the pixels counted too where that tells more, twenty-five refined modes)
        seed : of the random choices made where credible levels tie

        Raises
        ------
        ImageError, PoseError, UsageError, InputError
        """
        if effort not in EFFORTS:
            raise UsageError(f"no effort named {effort!r}{nearest_name(effort, EFFORTS)}")
        timing: dict[str, float] = {}
        frame, T_frame_sensor, image = _frame(image, T_world_sensor)
        settings = self._settings(effort, seed)
        with _timed(timing, "read"):
            observation = read_observation(image, self.sensor, kind, background)
        mask, warnings = observation.contact.mask, list(observation.warnings)
        common = {
            "frame": frame,
            "T_frame_sensor": T_frame_sensor,
            "seed": seed,
            "observations": [observation],
            "settings": settings | {"kind": observation.kind},
            "timing_ms": timing,
        }
        if not mask.any():
            elsewhere = prior_log_density(prior, self.mesh, frame, self.cache_dir)
            nothing = Posterior(self.index, np.zeros(0, np.int64), np.zeros(0), contact=False, **common)
            return replace(nothing, elsewhere=elsewhere, warnings=warnings)
        log_prior = None
        with _timed(timing, "score"):
            if prior is None:
                rows = self.scorer.rows(self.index, mask, EFFORTS[effort].resolved)
            else:
                log_prior = prior_log_mass(self.index, prior, T_frame_sensor, frame, self.cache_dir)
                rows = self.scorer.cells(self.index, mask, log_prior, EFFORTS[effort].resolved == "all")
        with _timed(timing, "posterior"):
            common["settings"] |= _worth(rows.by, rows.calibration)
            log_prob = posterior_log_prob(rows.score, rows.log_prior, rows.calibration)
            evidence, likeliest = self.scorer.witness.evidence(self.index, mask, log_prior)
            posterior = Posterior(self.index, rows.first, log_prob, runs=rows.runs, log_evidence=evidence, **common)
        if prior is None and self.scorer.witness.odd(evidence, likeliest):
            warnings.append("the contact is unlike any touch of this object that was simulated: is it the right part?")
        with _timed(timing, "refine"):
            posterior = self._refinery.refine(
                posterior, observation.contact, EFFORTS[effort].modes, EFFORTS[effort].thorough
            )
        return replace(posterior, warnings=warnings)

    def simulate(self, T_sensor_object: Any) -> Contact:
        """What the sensor would see at a pose (4, 4), without noise (thesis 6.1.3)."""
        T = check_transforms(T_sensor_object, "T_sensor_object")
        if T.shape != (4, 4):
            raise UsageError(f"simulate: expected one pose (4, 4), got shape {T.shape}")
        return self.space.caster.contact(self.sensor, T)

    def __repr__(self) -> str:
        name = self.scorer.name
        return f"Localizer({self.mesh.name} on {self.sensor.name}, {len(self.index):,} poses, scored by {name})"

    @property
    def mesh(self) -> Mesh:
        return self.index.mesh

    @property
    def sensor(self) -> Sensor:
        return self.index.sensor

    @cached_property
    def space(self) -> ContactSpace:
        """The object's contact pose space, undiscretised."""
        return ContactSpace(self.mesh, self.sensor, self.index.approach)

    @cached_property
    def _refinery(self) -> Refinery:
        return Refinery(self.space)

    def _settings(self, effort: str, seed: int) -> dict[str, Any]:
        return {
            "effort": effort,
            "seed": seed,
            "scorer": self.scorer.name,
            "max_poses": self.max_poses,
            "poses": len(self.index),
            "grid": self.index.resolution.to_json(),
            "approach": None
            if self.index.approach is None
            else [(np.asarray(v, float).tolist(), float(a)) for v, a in self.index.approach],
        }


def _worth(scored_by: str, calibration: Calibration) -> dict[str, Any]:
    return {"scored_by": scored_by, "temperature": calibration.temperature, "floor": calibration.floor}


def _frame(image: Any, T_world_sensor: Any) -> tuple[str, Any, Any]:
    """The posterior's frame, the sensor's pose in it, and the image."""
    several = isinstance(image, list | tuple)
    if several and len(image) != 1:
        raise UsageError(f"localize: expected one image, got {len(image)}; localize them one at a time")
    if several:
        image = image[0]
    if T_world_sensor is None:
        return "sensor", np.eye(4), image
    T = check_transforms(T_world_sensor, "T_world_sensor")
    if T.shape not in ((4, 4), (1, 4, 4)):
        raise UsageError(f"T_world_sensor: expected one pose for one image, got shape {T.shape}")
    return "world", T.reshape(4, 4), image


@contextmanager
def _timed(timing: dict[str, float], stage: str):
    start = time.perf_counter()
    yield
    timing[stage] = 1e3 * (time.perf_counter() - start)
