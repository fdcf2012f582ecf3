"""From a mesh and tactile images to the distribution of the object's pose: the thesis's method, a call a step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from geomtact.contact_space.cell_transfer import ExtrinsicsStd
from geomtact.contact_space.resolution import MAX_POSES
from geomtact.geometry.approach import Approach
from geomtact.geometry.mesh import Mesh
from geomtact.inference.effort import Effort, effort_of
from geomtact.inference.facts import Provenance
from geomtact.inference.fusion import fused_posterior
from geomtact.inference.posterior import Posterior
from geomtact.inference.preparation import PreparedObject, prepare_each
from geomtact.inference.prior import opened, reference_of
from geomtact.inference.repeated_images import counted_once
from geomtact.inference.resolve import resolve_touch
from geomtact.inference.sequence import track
from geomtact.inference.single_touch import (
    drop_lost_contact_prior,
    refine_modes,
    touch_posterior,
)
from geomtact.inference.views import read_views
from geomtact.planning.next_touch import Action, next_touch
from geomtact.progress import Progress
from geomtact.scoring.catalogue import DEFAULT_SCORER
from geomtact.sensing.sensor import Sensor


class Localizer(PreparedObject):
    """Localizes one object on one sensor, or on several; its attributes are those of :class:`PreparedObject`."""

    @classmethod
    def prepare(
        cls,
        mesh: str | Path | Mesh,
        unit: str | None = None,
        sensor: str | Path | Sensor | Sequence[str | Path | Sensor] = "gelslim",
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
        mesh : name of a bundled object, path of a mesh file, or a Mesh
        unit : "mm", "cm", "m" or "inch"; needed for files that state none
        sensor : name of a bundled sensor, path of a TOML file, or a Sensor; or a list of them, one for each image
        approach : [(direction (3,), half angle)]: only touches whose direction from the object towards the sensor, in
            the object frame, lies within the angle [rad] of one of these; 0 means exactly that face
        scorer : one of ``geomtact.scoring.catalogue.SCORERS``, or weights (.safetensors)
        max_poses : about how many poses the grid may have; plane faces add up to a quarter, on plates three quarters
        cache_dir : folder of the index cache; by default ``$GEOMTACT_CACHE`` or the user's cache folder
        progress : called with the share done (0 to 1) and what is being done

        Raises
        ------
        MeshError, SensorError, UsageError, CacheError, InputError
        """
        pairs = prepare_each(mesh, unit, sensor, approach, scorer, max_poses, cache_dir, progress)
        first, *others = (cls(index, fitted, max_poses, cache_dir) for index, fitted in pairs)
        return replace(first, others=tuple(others))

    def localize(
        self,
        image: Any,
        kind: str = "auto",
        background: Any = None,
        T_world_sensor: Any = None,
        prior: Any = None,
        effort: str | Effort = "balanced",
        seed: int = 0,
        extrinsics_std: ExtrinsicsStd | None = None,
    ) -> Posterior:
        """The distribution of the object's pose, given the image of one sensor, or of several (thesis 6.1 to 6.3).

        Parameters
        ----------
        image : path, array or Observation: a mask, a depth map [m] or a tactile image (see ``sensing.reading``); or a list of
            them, one for each of several sensors that touch the object at the same time
        kind : "auto", "mask", "height" or "reading"
        background : image without contact, for tactile images; or a list, one for each image
        T_world_sensor : (4, 4), or one for each image (n, 4, 4): the posterior is then in the world frame
        prior : None, a Posterior, its path, a pair (poses, log weights), a GaussianPrior or a log density
        effort : "fast", "balanced" or "exact", or an Effort
        seed : of all random choices: poses drawn within the cells, in refining, and where credible levels tie
        extrinsics_std : uncertainty of the sensors' poses relative to the first one's; where it is not stated, standard
            deviations of 0.2 to 3 mm and degrees are equally probable by their logarithm

        Raises
        ------
        ImageError, PoseError, UsageError, InputError, CacheError
        NoPoseAgreesError
            Of several sensors: there is no pose at which the object touches all that show contact.
        """
        resolved = effort_of(effort)
        views = read_views(image, T_world_sensor, self.sensors, kind, background)
        prior = opened(prior, self.cache_dir)
        each = self.by_sensor if self.others else [self] * len(views)
        touches = [
            touch_posterior(
                one.index,
                one.scorer,
                view,
                prior if len(views) == 1 else None,
                Provenance(effort, one.scorer.name, one.max_poses),
                seed,
            )
            for one, view in zip(each, views, strict=True)
        ]
        if len(views) == 1:
            posterior, log_prior = touches[0]
            posterior, prior = drop_lost_contact_prior(posterior, prior)
            posterior = resolve_touch(posterior, prior, log_prior, self.scorer, resolved)
            posterior = refine_modes(posterior, self.mode_refiner, resolved)
        else:
            refiners = [one.mode_refiner for one in each]
            posterior = fused_posterior([touch for touch, _ in touches], refiners, prior, resolved, extrinsics_std)
        return counted_once(replace(posterior, reference=reference_of(prior, posterior)), prior)

    def track(
        self, frames: Iterable[Any], T_world_sensor: Any = None, motion: Any = None, **options: Any
    ) -> Iterator[Posterior]:
        """A Posterior for each frame, given all frames up to it (thesis 8.1); see :func:`geomtact.inference.sequence.track`."""
        return track(self, self.localize, frames, T_world_sensor, motion, **options)

    def next_touch(self, posterior: Posterior, actions: Any = None, seed: int = 0) -> list[Action]:
        """Actions by expected information for their cost (thesis 8.2); see :func:`geomtact.planning.next_touch.next_touch`."""
        return next_touch(posterior, actions, seed=seed)
