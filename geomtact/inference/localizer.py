"""From a mesh and a tactile image to the distribution of the part's pose: the thesis's method, a call a step."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomtact.contact_space.carry import RigStd
from geomtact.contact_space.index import Index
from geomtact.contact_space.resolution import MAX_POSES
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.store import default_cache_dir, open_index
from geomtact.errors import CacheError, UsageError
from geomtact.geometry.approach import Approach, to_json
from geomtact.geometry.mesh import Mesh
from geomtact.geometry.mesh_file import load_mesh
from geomtact.inference.effort import Effort, effort_of
from geomtact.inference.fusion import fused_posterior
from geomtact.inference.posterior import Posterior
from geomtact.inference.prior import lost_contact, opened, prior_log_density, prior_log_mass, reference_of
from geomtact.inference.refine import Refinery
from geomtact.inference.refine_by_outline import few_are_left, refine_by_outline
from geomtact.inference.refine_together import refine_together
from geomtact.inference.repeated_images import counted_once, digest
from geomtact.inference.rig import views_of
from geomtact.inference.search import View
from geomtact.planning.next_touch import Action, next_touch
from geomtact.progress import Progress
from geomtact.scoring.calibration import Calibration, posterior_log_prob
from geomtact.scoring.catalogue import DEFAULT_SCORER
from geomtact.scoring.fitted import FittedScorer, fitted_scorer
from geomtact.se3 import Array, check_pose
from geomtact.sensing.contact import Contact, SoftMask
from geomtact.sensing.reading import read_observation
from geomtact.sensing.sensor import Sensor

_HOLLOW = 0.01  # share of the surface in hollows that the sensor may fit into, from which it is warned of
# nats by which an image is likelier without the prior: were the moments' likelihood exact, one image in exp(5), or 148, at most
# would be, its pose drawn from the prior (Markov's inequality)
_CONTRADICTS = 5.0


@dataclass(frozen=True, eq=False)
class Localizer:
    """Localizes one object on one sensor.

    Attributes
    ----------
    index : every touch of the object on the sensor, simulated beforehand
    scorer : the calibrated score that compares a contact with them
    max_poses, cache_dir : as given to :meth:`prepare`
    others : localizers of the same object on the second and further sensors, where they are not all alike
    """

    index: Index
    scorer: FittedScorer
    max_poses: int = MAX_POSES
    cache_dir: str | Path | None = None
    others: tuple[Localizer, ...] = ()

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
        mesh : name of a bundled part, path of a mesh file, or a Mesh
        unit : "mm", "cm", "m" or "inch"; needed for files that state none
        sensor : name of a bundled sensor, path of a TOML file, or a Sensor; or a list of them, one for each image that
            :meth:`localize` is to be given at once
        approach : [(direction (3,), half angle)]: only touches whose direction from the object towards the sensor, in
            the object frame, lies within the angle [rad] of one of these; 0 means exactly that face
        scorer : how contacts are compared, one of ``geomtact.scoring.catalogue.SCORERS``, or weights (.safetensors)
        max_poses : about how many poses the grid may have; plane faces add up to a quarter, on plates three quarters
        cache_dir : folder of the index cache; by default ``$GEOMTACT_CACHE`` or the user's cache folder
        progress : called with the share done (0 to 1) and what is being done

        Raises
        ------
        MeshError, SensorError, UsageError, CacheError
        InputError
            Weights that cannot be used.
        """
        if not isinstance(max_poses, int | np.integer):
            raise UsageError(f"max_poses: expected a whole number, got {max_poses!r}")
        if not isinstance(sensor, str | Path | Sensor):
            if not sensor:
                raise UsageError("prepare: expected a sensor for every image, got an empty list")
            options: dict[str, Any] = {"scorer": scorer, "max_poses": max_poses, "cache_dir": cache_dir}
            sensors = [Sensor.load(each) for each in sensor]
            alone = {
                each: cls.prepare(mesh, unit, each, approach, **options, progress=progress)
                for each in dict.fromkeys(sensors)
            }
            first, *others = (_calibrated_as(alone[each], each) for each in sensors)
            return replace(first, others=tuple(others))
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
        effort: str | Effort = "balanced",
        seed: int = 0,
        rig: RigStd | None = None,
    ) -> Posterior:
        """The distribution of the object's pose, given what one sensor shows, or several (thesis 6.1 to 6.3).

        Parameters
        ----------
        image : path or array: a mask, a height map [m] or an RGB reading (see ``sensing.reading``); or a list of them, one for
            each of several sensors that touch the object at the same time
        kind : "auto", "mask", "height" or "reading"
        background : a reading without contact, for readings; or a list, one for each image
        T_world_sensor : (4, 4), or one for each image (n, 4, 4): the posterior is then in the world frame
        prior : None, a Posterior, its path, a pair (poses, log weights), a GaussianPrior or a log density (see
            ``inference.prior``)
        effort : "fast" (the grid's blocks, nothing refined), "balanced" (its cells, five refined modes) or "exact" (every
            cell, the pixels counted too where that tells more, twenty-five refined modes, by the outline where few cells are
            left), or an Effort of one's own
        seed : of the random choices made where credible levels tie, and in refining
        rig : how well the sensors' poses relative to each other are known

        Raises
        ------
        ImageError, PoseError, UsageError, InputError
        NoPoseAgreesError
            Of several sensors: there is no pose at which the part touches all that show contact.
        CacheError
            The index of a prior's file cannot be opened or built.
        """
        how = effort_of(effort)
        images, frame, T_frame_sensor = views_of(image, T_world_sensor)
        backgrounds = background if isinstance(background, list | tuple) else [background] * len(images)
        if len(backgrounds) != len(images):
            raise UsageError(f"localize: expected one background, or {len(images)}, got {len(backgrounds)}")
        localizers = (self, *self.others) if self.others else (self,) * len(images)
        if len(localizers) != len(images):
            raise UsageError(
                f"localize: prepared for {len(localizers)} sensors, got {len(images)} images; give one for each"
            )
        prior = opened(prior, self.cache_dir)
        if len(images) == 1:
            touch, before = self.touch(images[0], kind, backgrounds[0], T_frame_sensor[0], frame, prior, effort, seed)
            if not touch.contact and lost_contact(prior, self.sensor, T_frame_sensor[0]):
                told = "the prior says that the object touches this sensor where it stands: it is given up, contact was lost"
                touch, prior = replace(touch, elsewhere=None, warnings=[*touch.warnings, told]), None
            posterior = self._refined(touch, before, how)
        else:
            touches = [
                each.touch(shown, kind, empty, T, frame, None, effort, seed)[0]
                for each, shown, empty, T in zip(localizers, images, backgrounds, T_frame_sensor, strict=True)
            ]
            refineries = [each.refinery for each in localizers]
            posterior = fused_posterior(touches, refineries, prior, how.modes, rig)
        return counted_once(replace(posterior, reference=reference_of(prior, posterior)), prior)

    def touch(
        self,
        image: Any,
        kind: str,
        background: Any,
        T_frame_sensor: Array,
        frame: str,
        prior: Any,
        effort: str | Effort,
        seed: int,
    ) -> tuple[Posterior, NDArray[np.floating] | None]:
        """What one sensor at ``T_frame_sensor`` (4, 4) tells, not refined; and the log mass of every cell (M,) before that, where
        there is a prior and contact. The rest as in :meth:`localize`."""
        timing: dict[str, float] = {}
        resolved = effort_of(effort).resolved
        settings = self._settings(effort, seed)
        with _timed(timing, "read"):
            observation = read_observation(image, self.sensor, kind, background)
        contact, above, warnings = observation.contact, 0.0, [*self.mesh.warnings, *observation.warnings]
        mask: SoftMask = contact.soft_mask
        if contact.height is not None and contact.height[contact.mask].any():
            # a contour line of the gel where it surely lies on the object, which reaches below it by as much
            above = contact.sure_depth
            mask = contact.deeper(above)
        touched = bool((mask > 0.5).any())
        common: dict[str, Any] = {
            "frame": frame,
            "T_frame_sensor": T_frame_sensor,
            "seed": seed,
            "observations": [observation],
            "settings": settings
            | {
                "kind": observation.kind,
                "contact_method": observation.method,
                "heights": contact.height is not None,
                # a mask is the same in whichever two values
                "images": [
                    digest(contact.mask if observation.kind == "mask" else observation.image) if touched else None
                ],
            },
            "timing_ms": timing,
        }
        if not touched:
            elsewhere = prior_log_density(self.index, prior, frame)
            nothing = Posterior(self.index, np.zeros(0, np.int64), np.zeros(0), contact=False, **common)
            return replace(nothing, elsewhere=elsewhere, warnings=warnings), None
        log_prior = None
        with _timed(timing, "score"):
            if prior is not None:
                log_prior = prior_log_mass(self.index, prior, T_frame_sensor, frame)
            if prior is None and not above:
                rows = self.scorer.rows(self.index, mask, resolved)
            else:
                rows = self.scorer.cells(self.index, mask, log_prior, resolved == "all", above)
        with _timed(timing, "posterior"):
            common["settings"] |= _worth(rows.by, rows.calibration)
            log_prob = posterior_log_prob(rows.score, rows.log_prior, rows.calibration)
            model = self.scorer.evidence_model
            usual, likeliest = model.evidence(self.index, mask)
            evidence = usual if log_prior is None else model.evidence(self.index, mask, log_prior, above)[0]
            posterior = Posterior(self.index, rows.first, log_prob, runs=rows.runs, log_evidence=evidence, **common)
        if log_prior is not None:
            unknown = model.evidence(self.index, mask, self.index.log_weight, above)[0] if above else usual
            if unknown - evidence > _CONTRADICTS:
                warnings.append(
                    f"the prior and the image contradict each other, by {unknown - evidence:.0f} nats: look whether both are of "
                    "this touch and part, and at the prior's frame and units"
                )
        odd = model.is_outlier(usual, likeliest)
        if odd:
            warnings.append("the contact is unlike any touch of this object that was simulated: is it the right part?")
        if self.space.hollow > _HOLLOW:
            warnings.append(
                f"{100 * self.space.hollow:.0f} % of the part's surface lies in hollows wider than the sensor's window, and "
                "touches in there are taken for others: touch from outside, or localize on a mesh of that wall alone"
            )
        return replace(posterior, warnings=warnings, settings=posterior.settings | {"odd": odd}), log_prior

    def _refined(self, touch: Posterior, log_prior: NDArray[np.floating] | None, how: Effort) -> Posterior:
        """``touch`` with its leading modes below the grid: a mask is registered mode by mode; heights, and outlines where few
        cells are left, are searched for and weighed. ``log_prior`` as :meth:`touch` gives it."""
        if not touch.contact:
            return touch
        with _timed(touch.timing_ms, "refine"):
            contact = touch.observation.contact
            heights = contact.height is not None
            if not how.modes or not (heights or (how.outlines and few_are_left(touch))):
                return self.refinery.refine(touch, contact, how.modes, how.thorough)
            view = View(self.refinery, contact, np.eye(4))
            if heights:
                return refine_together(touch, [view], how.modes, touch.seed, log_prior)
            return refine_by_outline(touch, view, how.modes, touch.seed, log_prior)

    def simulate(self, T_sensor_object: Any) -> Contact:
        """What the sensor would see at a pose (4, 4), object to sensor in metres, without noise (thesis 6.1.3): mask and heights
        at the sensor's own resolution.

        Raises
        ------
        PoseError
            Not a rigid pose.
        """
        return self.space.caster.contact(self.sensor, check_pose(T_sensor_object, "T_sensor_object"))

    def track(
        self, frames: Iterable[Any], T_world_sensor: Any = None, motion: Any = None, **options: Any
    ) -> Iterator[Posterior]:
        """A Posterior for each of a sequence of frames, given all frames up to it (thesis 8.1).

        All parameters and options (``effort``, ``prior``, ``most``, ``kind``, ``background``, ``counts``, ``fresh``,
        ``on_error``, ``seed``) are those of :func:`geomtact.inference.sequence.track`.
        """
        from geomtact.inference.sequence import track

        return track(self, frames, T_world_sensor, motion, **options)

    def next_touch(self, posterior: Posterior, actions: Any = None, seed: int = 0) -> list[Action]:
        """Touches and probes by what they are expected to tell for their cost, the best first (thesis 8.2).

        Parameters are those of :func:`geomtact.planning.next_touch.next_touch`.
        """
        return next_touch(posterior, actions, seed=seed)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled by what it was prepared from, with the index and the score read from the cache, once in each process."""
        if self.index.folder is None:
            return Localizer, tuple(getattr(self, field.name) for field in fields(self))
        return _reopened, (
            self.index,
            self.scorer.name,
            _fit_of(self.scorer),
            self.max_poses,
            self.cache_dir,
            self.others,
        )

    def __repr__(self) -> str:
        name = self.scorer.name
        return f"Localizer({self.mesh.name} on {self.sensor.name}, {len(self.index):,} poses, scored by {name})"

    @property
    def mesh(self) -> Mesh:
        return self.index.mesh

    @property
    def sensor(self) -> Sensor:
        return self.index.sensor

    @property
    def space(self) -> ContactSpace:
        """The object's contact pose space, undiscretised."""
        return self.index.space

    @cached_property
    def refinery(self) -> Refinery:
        return Refinery(self.space)

    def _settings(self, effort: str | Effort, seed: int) -> dict[str, Any]:
        return {
            "effort": effort if isinstance(effort, str) else asdict(effort),
            "seed": seed,
            "scorer": self.scorer.name,
            "max_poses": self.max_poses,
            "poses": len(self.index),
            "grid": self.index.resolution.to_json(),
            "approach": to_json(self.index.approach),
        }


def _calibrated_as(localizer: Localizer, sensor: Sensor) -> Localizer:
    """``localizer`` on another sensor of the same geometry, whose readings are read in its own way."""
    if all(getattr(localizer.sensor, f.name) == getattr(sensor, f.name) for f in fields(Sensor) if f.name != "note"):
        return localizer
    return replace(localizer, index=replace(localizer.index, sensor=sensor))


@lru_cache(4)
def _reopened(
    index: Index,
    scorer: str,
    fit: tuple[Calibration, Calibration | None, bool],
    max_poses: int,
    cache_dir: str | Path | None,
    others: tuple[Localizer, ...],
) -> Localizer:
    """The localizer that was pickled."""
    fitted = fitted_scorer(scorer, index, index.folder)
    if _fit_of(fitted) != fit:
        raise CacheError(
            f"cache entry {index.folder}: its score {scorer!r} is not the one that was pickled; prepare the object again, and "
            "pickle it anew"
        )
    return Localizer(index, fitted, max_poses, cache_dir, others)


def _fit_of(scorer: FittedScorer) -> tuple[Calibration, Calibration | None, bool]:
    """By what a score differs from another of its name."""
    return scorer.calibration, scorer.exact_calibration, scorer.cascade is None


def _worth(scored_by: str, calibration: Calibration) -> dict[str, Any]:
    return {"scored_by": scored_by, "temperature": calibration.temperature, "floor": calibration.floor}


@contextmanager
def _timed(timing: dict[str, float], stage: str):
    start = time.perf_counter()
    yield
    timing[stage] = 1e3 * (time.perf_counter() - start)
