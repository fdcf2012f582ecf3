"""The distribution of a pose within the cells of an index: what the sampler leaves of it, and the density at any pose.

Relative to the uniform distribution, its density at a pose T is a mixture over powers p of the likelihood L,

    sum over p of  w(p) prior(T) coarse(T)^(1 - p) L(T)^p / Z(p),

averaged over errors of the object's scale and of the contact's place. The weights w are fitted (``scoring.contact_likelihood``),
the coarse density is that of the cells, and the evidences Z come from the sampler. So the density is known wherever L is made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomtact.contact_space.cell_transfer import ExtrinsicsStd
from geomtact.contact_space.contact_maps import Placements, located
from geomtact.contact_space.index import Index
from geomtact.inference.particles import OtherSensor, Particles, Target, tempered
from geomtact.inference.pose_prior import CellPrior, NormalPrior, pose_prior_of
from geomtact.inference.systematic_errors import nodes, nodes_beside, undisplaced
from geomtact.scoring.contact_likelihood import INTERCEPT, POWERS, ContactQuery, placed_indentation
from geomtact.se3 import Array, check_pose, check_transforms

_PART = 512  # poses whose density is made at a time
# what files hold of a sensor
_OF_QUERY = ("touched", "source", "depths", "lying", "weight")
_OF_OTHER = (*_OF_QUERY, "sensor", "index", "T_sensor_first", "extrinsics_std")


@dataclass(frozen=True, eq=False)
class Density:
    """The density of the pose after one touch: a mixture of the posteriors by powers of the likelihood, ``POWERS`` or the
    smallest of them, each averaged over the errors that the whole contact has in common.

    Attributes
    ----------
    target : what poses without errors are judged by
    log_evidence : of each posterior, the log of the mean of the power of the likelihood over the coarse posterior
    powers : of the likelihood; all but the last are of ``POWERS``
    log_inside : log of the share of the poses with errors that are in the contact pose space
    trust : probability that the sampler found where the likelihood is high; else the pose has the coarse posterior
    """

    target: Target
    log_evidence: tuple[float, ...]
    powers: tuple[float, ...] = POWERS
    log_inside: float = 0.0
    trust: float = 1.0

    @property
    def index(self) -> Index:
        """All touches of the object."""
        return self.target.index

    @cached_property
    def weights(self) -> Array:
        """Weight of each posterior; the last one has those of the powers that are left out too."""
        weights, last = self.target.weights, len(self.powers) - 1
        weights = self.trust * np.append(weights[:last], weights[last:].sum())
        weights[0] += 1 - self.trust
        return weights

    def by_power(self, log_likelihood: Array, log_coarse: Array) -> Array:
        """Log (..., K) of coarse^(1 - p) L^p / Z(p) by each power p, from the log likelihood and the log density of the coarse
        posterior (...)."""
        each = [
            tempered(log_likelihood, log_coarse, power) - log_evidence
            for power, log_evidence in zip(self.powers, self.log_evidence, strict=True)
        ]
        return np.stack(each, -1)

    @property
    def _sure(self) -> NDArray[np.bool_]:
        """Under which of the powers (K,) no sensor may be missed."""
        return np.array(self.powers) > 0

    def of_exact(self, particles: Particles) -> Array:
        """Log density (n,) of the mixture at ``particles`` (n,), if there were no errors but theirs."""
        each = self.by_power(particles.log_likelihood, particles.log_coarse) + np.log(self.weights)
        each[np.ix_(particles.missed, self._sure)] = -np.inf
        return np.asarray(particles.log_prior + np.logaddexp.reduce(each, -1))

    def log_density(self, T: ArrayLike) -> Array:
        """Log density (n,), relative to the uniform, at poses ``T_sensor_object`` (n, 4, 4) of the contact pose space."""
        return self.mixed(self.of_powers(T))

    def mixed(self, of_powers: Array) -> Array:
        """Log density (n,) where :meth:`of_powers` is (n, K)."""
        return np.asarray(np.logaddexp.reduce(of_powers + np.log(self.weights), -1)) - self.log_inside

    def of_powers(self, T: ArrayLike) -> Array:
        """As :meth:`log_density` of each posterior (n, K), but not divided by the share that ``log_inside`` is the log of."""
        T = np.asarray(T, float).reshape(-1, 4, 4)
        parts = [self._of_powers(T[first : first + _PART]) for first in range(0, len(T), _PART)]
        return np.concatenate(parts) if parts else np.zeros((0, len(self.log_evidence)))

    def _of_powers(self, T: Array) -> Array:
        index, query, n = self.index, self.target.query, len(T)
        poses, membrane = located(index, T)
        errors, log_weight = nodes()
        centre = undisplaced(np.column_stack([poses.centre, membrane])[:, None], errors, query.centroid)
        flat, rows = centre.reshape(-1, 3), np.repeat(np.arange(n), len(errors))
        place = index.place_of(index.rotation[poses.place[rows]].astype(np.int64), flat)
        reach = poses.reach[rows] + flat[:, 2] - membrane[rows]
        asked = Placements(place, poses.direction[rows], poses.rotation[rows], flat[:, :2], reach)
        cut, log_likelihood = query.compare(index, asked, flat[:, 2])
        each = self.by_power(log_likelihood, self.target.log_coarse[place])
        each[~np.isfinite(log_likelihood)] = -np.inf  # what touches nothing is no pose, by whatever power
        if isinstance(self.target.prior, CellPrior):
            each += self.target.prior.log_density(asked, cut.reach - flat[:, 2])[:, None]
        # volumes with errors are larger
        each = each.reshape(n, len(errors), -1) + (log_weight - 3 * errors[:, 0])[:, None]
        out = np.asarray(np.logaddexp.reduce(each, 1))
        if isinstance(self.target.prior, NormalPrior):
            out += self.target.prior.log_density(T)[:, None]
        powers = np.array(self.powers)[self._sure]
        for other in self.target.others:
            stand = nodes_beside(other.extrinsics_std)
            found, missed = other.log_likelihood(np.repeat(T, len(stand), 0), np.tile(stand, (n, 1, 1)))
            found = np.where(missed > 0, -np.inf, found).reshape(n, len(stand), 1)
            out[:, self._sure] += np.logaddexp.reduce(powers * found, 1) - np.log(len(stand))
        return out


@dataclass(frozen=True, eq=False)
class Explored:
    """The distribution of the pose after one touch.

    Attributes
    ----------
    density : at any pose
    poses : T_sensor_object (n, 4, 4) drawn from it, equally probable
    depth : penetration (n,) [m]
    log_density : at the poses (n,)
    contacts : that were cut
    hearts : (m, 4, 4) the densest pose that was found of each leading mode, the most probable mode first
    masses : (m,) of these modes
    """

    density: Density
    poses: Array
    depth: Array
    log_density: Array
    contacts: int
    hearts: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    masses: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def index(self) -> Index:
        """All touches of the object."""
        return self.density.index

    @cached_property
    def weight(self) -> Array:
        """Mass (n,) of each pose."""
        return np.full(len(self.poses), 1 / len(self.poses))

    @property
    def expected_gain(self) -> float:
        """Mean log density under the distribution itself [nats]."""
        return float(self.log_density.mean())

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """``n`` poses T_sensor_object (n, 4, 4) drawn by ``rng`` among the particles, at any image under the symmetry.

        Instead of the few that no depth makes touch by the mesh, others are drawn again.
        """
        rows = rng.choice(len(self.weight), n, p=self.weight)
        T, touches = self._settled(self.poses[rows], self.depth[rows])
        if touches.any():
            T[~touches] = T[rng.choice(np.flatnonzero(touches), n - int(touches.sum()))]
        return self.index.directions.any_image(T, rng)

    def settled_hearts(self, k: int) -> Array:
        """The first ``k`` hearts T_sensor_object (n, 4, 4).

        Height maps miss what lies between their pixels, so that a pose may touch by them and not quite by the mesh, or press a
        little too deep: it is moved along z.
        """
        T = self.hearts[:k]
        return self._settled(T, self.density.target.particles_at(T).depth)[0]

    def _settled(self, T: Array, depth: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Poses ``T`` (n, 4, 4), ``depth`` (n,) deep by height maps, as of :meth:`settled_hearts`; and which (n,) touch by the
        mesh."""
        T, space = T.copy(), self.index.space
        touches = np.isfinite(space.penetration(T))
        off = np.flatnonzero(~touches)
        settled, ok = space.settle(T[off], depth[off])
        T[off[ok]], touches[off[ok]] = settled[ok], True
        return T, touches

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that :meth:`of_arrays` needs beside the index."""
        target = self.density.target
        return {
            "T": self.poses,
            "depth": self.depth,
            "log_density": self.log_density,
            "log_evidence": np.array(self.density.log_evidence),
            "powers": np.array(self.density.powers),
            "log_inside": np.array(self.density.log_inside),
            "trust": np.array(self.density.trust),
            "log_coarse": target.log_coarse.astype(np.float32),
            **({} if target.prior is None else target.prior.arrays()),
            "contacts": np.array(self.contacts),
            "hearts": self.hearts,
            "masses": self.masses,
            **_of_query(target.query),
            "others": np.array(len(target.others)),
            **{f"other_{i}_{k}": v for i, other in enumerate(target.others) for k, v in _of_other(other).items()},
        }

    @classmethod
    def of_arrays(
        cls, index: Index, arrays: Mapping[str, NDArray[Any]], open_index: Callable[[str, str], Index]
    ) -> Explored:
        """Inverse of :meth:`arrays`; ``open_index`` gives the index of another sensor, by its TOML and the index's key.

        Raises
        ------
        KeyError, ValueError, GeomtactError
            They are not what it gives, or the index of another sensor cannot be opened.
        """
        T, log_coarse = check_transforms(arrays["T"]), arrays["log_coarse"].astype(float)
        prior = pose_prior_of(index, arrays)
        if not 1 < len(arrays["log_evidence"]) == len(arrays["powers"]) <= len(POWERS) or not len(T) == len(
            arrays["depth"]
        ) == len(arrays["log_density"]):
            raise ValueError("particles of different number")
        hearts = check_transforms(arrays["hearts"])
        if len(hearts) != len(arrays["masses"]):
            raise ValueError("modes without their masses")
        if len(log_coarse) != index.places:
            raise ValueError("densities that are not of its grid")
        others = []
        for i in range(int(arrays["others"])):
            its = {k: arrays[f"other_{i}_{k}"] for k in _OF_OTHER}
            on = open_index(str(its["sensor"]), str(its["index"]))
            T_sensor_first = check_pose(its["T_sensor_first"], "T_sensor_first")
            std = ExtrinsicsStd(*its["extrinsics_std"].tolist()) if len(its["extrinsics_std"]) else None
            others.append(OtherSensor(on, _query(its, on), T_sensor_first, std))
        target = Target(index, _query(arrays, index), log_coarse, prior, tuple(others))
        return cls(
            Density(
                target,
                tuple(arrays["log_evidence"].tolist()),
                tuple(arrays["powers"].tolist()),
                float(arrays["log_inside"]),
                float(arrays["trust"]),
            ),
            T,
            arrays["depth"],
            arrays["log_density"],
            int(arrays["contacts"]),
            hearts,
            arrays["masses"],
        )

    def credible_level(self, log_density: float) -> float:
        """Mass of the poses that are denser than ``log_density``."""
        return float(self.weight @ (self.log_density > log_density))


def _of_query(query: ContactQuery) -> dict[str, NDArray[Any]]:
    depths = query.indentation[:3] if query.indentation else 3 * (np.zeros((0, 0), np.float32),)
    return dict(zip(_OF_QUERY, (query.touched, np.array(query.source), *depths), strict=True))


def _of_other(other: OtherSensor) -> dict[str, NDArray[Any]]:
    std = other.extrinsics_std
    return {
        **_of_query(other.query),
        "sensor": np.array(other.index.sensor.to_toml()),
        "index": np.array(other.index.key),
        "T_sensor_first": other.T_sensor_first,
        "extrinsics_std": np.array([] if std is None else [std.rotation, std.translation]),
    }


def _query(arrays: Mapping[str, NDArray[Any]], index: Index) -> ContactQuery:
    """Inverse of :func:`_of_query`, of a contact on the sensor of ``index``.

    Raises
    ------
    ValueError
        It is of no known source.
    """
    source = str(arrays["source"])
    if source not in INTERCEPT:
        raise ValueError(f"a contact of another source: {source}")
    depths = arrays["depths"], arrays["lying"].astype(bool), arrays["weight"]
    found = placed_indentation(*depths, index.sensor) if depths[0].size else None
    return ContactQuery.showing(arrays["touched"].astype(bool), index.sensor, source, found)
