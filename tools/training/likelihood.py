"""Fits what the likelihood of a contact depends on: the rate of its energy and elastic shares.

Touches of procedural objects are explored by the sampler as it is. The poses that it leaves, of all powers, serve to compute
the evidence of other settings by importance sampling, so that the mean log density at the true poses can be climbed. Where the
settings move far, run it again with them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.special import logsumexp

from geomtact.contact_space.contact_maps import ContactMaps, located
from geomtact.contact_space.touches import Touch, random_touches
from geomtact.files import write_text
from geomtact.inference.particles import Particles, tempered
from geomtact.inference.sampler import Run, explore
from geomtact.kernels.contact_energy import SHARES
from geomtact.localizer import Localizer
from geomtact.progress import Progress
from geomtact.scoring.contact_likelihood import INTERCEPT, POWERS, RATE, RIGID, SHARE, ContactQuery, share_cells
from geomtact.se3 import Array
from geomtact.versions import versions
from tools.training.examples import SENSORS, drawn_object, resumed

SIZES = (0.5, 3.5)  # longest side of an object, in long sides of the window
MAX_POSES = 400_000  # of the grid
CONTACTS = 60_000  # of the sampler
KEPT = 1000  # poses of each power, at most
_STEPS, _RATE = 150, 0.08  # of the ascent (Adam)
_UNIT = 1e-9  # m^3, in which energies are held
_NOTHING = 1e3  # energy where the object is not touched

SCHEMA = "geomtact/contact-likelihood/1"
LEVELS = (0.5, 0.8, 0.9, 0.95)


@dataclass(frozen=True, eq=False)
class Example:
    """One touch, with n poses to compute evidences from. Energies are in mm^3.

    Attributes
    ----------
    energy, true_energy : (n, SHARES) at the poses, (SHARES,) at the true one
    log_coarse, true_log_coarse : (n,) log density of the coarse posterior, and at the true pose
    log_density, true_log_density : (n,) of the mixture that the poses were drawn from, and at the true pose
    elastic : whether the gel was
    """

    energy: NDArray[np.float32]
    log_coarse: Array
    log_density: Array
    true_energy: NDArray[np.float32]
    true_log_coarse: float
    true_log_density: float
    elastic: bool


@dataclass(frozen=True, eq=False)
class Tensors:
    """The columns of t examples: see :class:`Example`."""

    energy: torch.Tensor
    log_coarse: torch.Tensor
    log_density: torch.Tensor
    true_energy: torch.Tensor
    true_log_coarse: torch.Tensor
    true_log_density: torch.Tensor

    @classmethod
    def of(cls, examples: Sequence[Example]) -> Tensors:
        """With as many poses each as the fewest."""
        n = min(len(e.log_coarse) for e in examples)
        columns = []
        for name in cls.__dataclass_fields__:
            each = [np.asarray(getattr(e, name)) for e in examples]
            columns.append(torch.from_numpy(np.stack([a[:n] if len(a.shape) and len(a) > SHARES else a for a in each])))
        return cls(*columns)


def make_examples(
    folder: Path, objects: int, touches: int, seed: int, progress: Progress | None = None
) -> list[Example]:
    """``touches`` of each of so many ``objects``, in files of ``folder``, so that a stopped run goes on."""
    paths = [folder / f"{i}.npz" for i in range(objects)]
    return resumed(paths, lambda i: _examples_of(i, touches, seed), _save, _load, progress)


def _examples_of(i: int, touches: int, seed: int) -> Iterator[Example]:
    rng = np.random.default_rng([seed, i])
    sensor, mesh = drawn_object(i, SIZES, rng)
    localizer = Localizer.prepare(mesh, sensor=sensor, max_poses=MAX_POSES)
    maps = ContactMaps.of(localizer.index)
    for touch in random_touches(localizer.space, touches, int(rng.integers(1 << 31))):
        yield _example(localizer, maps, touch, rng)


def _example(localizer: Localizer, maps: ContactMaps, touch: Touch, rng: np.random.Generator) -> Example:
    query = ContactQuery.of(touch.mask, localizer.sensor)
    coarse = np.exp(localizer.scorer.log_mass(localizer.index, touch.mask)).sum(0)
    (run,) = explore(localizer.index, query, coarse, CONTACTS, rng)
    mixed = [p.take(rng.permutation(len(p))[:KEPT]) for p in run.particles[1:]]
    energy = np.concatenate([_energy(maps, query, p) for p in mixed])
    at_truth, place = _at_truth(maps, query, touch)
    lc = np.concatenate([p.log_coarse for p in mixed])
    ll = np.concatenate([p.log_likelihood for p in mixed])
    true_lc = float(run.density.target.log_coarse[place])
    true_ll = float(query.log_likelihood(at_truth)[0])
    return Example(
        _in_units(energy),
        lc,
        _mixture(run, ll, lc),
        _in_units(at_truth)[0],
        true_lc,
        float(_mixture(run, np.array([true_ll]), np.array([true_lc]))[0]),
        touch.elastic,
    )


def _energy(maps: ContactMaps, query: ContactQuery, particles: Particles) -> NDArray[np.float32]:
    poses = particles.poses
    return maps.compare(query.samples, query.area, poses, poses.reach - particles.depth).energy


def _at_truth(maps: ContactMaps, query: ContactQuery, touch: Touch) -> tuple[NDArray[np.float32], int]:
    poses, membrane = located(maps.index, touch.T_sensor_object[None])
    return maps.compare(query.samples, query.area, poses, membrane).energy, int(poses.place[0])


def _mixture(run: Run, ll: Array, lc: Array) -> Array:
    """Log density (n,) of the poses of all powers but 0 together, each the same share."""
    each = [
        tempered(ll, lc, power) - evidence for power, evidence in zip(POWERS[1:], run.log_evidence[1:], strict=True)
    ]
    return np.asarray(logsumexp(each, 0)) - np.log(len(each))


def _in_units(energy: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.where(np.isfinite(energy), energy / _UNIT, _NOTHING).astype(np.float32)


def _save(path: Path, examples: Sequence[Example]) -> None:
    columns = {name: np.stack([getattr(e, name) for e in examples]) for name in Example.__dataclass_fields__}
    with open(path, "wb") as file:
        np.savez(file, allow_pickle=False, **columns)


def _load(path: Path) -> list[Example]:
    with np.load(path, allow_pickle=False) as data:
        columns = [data[name] for name in Example.__dataclass_fields__]
    return [Example(*each) for each in zip(*columns, strict=True)]


@dataclass(frozen=True)
class Fit:
    """Fitted settings, and how well they do on the touches they are fitted to.

    Attributes
    ----------
    rate : [nats/mm^3]
    share : of the beta distribution of elastic shares
    weights : of the powers
    gain, expected_gain : means [nats], at the true poses and under the posteriors themselves
    coverage : share of the touches whose true pose is in the regions of ``LEVELS``: of all, rigid, elastic ones
    """

    rate: float
    share: tuple[float, float]
    weights: tuple[float, ...]
    gain: float
    expected_gain: float
    coverage: tuple[tuple[float, ...], ...]


class _Model(torch.nn.Module):
    """The settings as logarithms; it begins where the package is."""

    def __init__(self) -> None:
        super().__init__()
        self.rate = torch.nn.Parameter(torch.tensor(RATE * _UNIT).log())
        self.share = torch.nn.Parameter(torch.tensor(SHARE).log())
        self.weight = torch.nn.Parameter(torch.tensor(INTERCEPT["mask"]))

    def log_likelihood(self, energy: torch.Tensor) -> torch.Tensor:
        """Of energies (..., SHARES): (...)."""
        middle, width = (torch.from_numpy(each).float() for each in share_cells())
        a, b = self.share.exp()
        elastic = F.log_softmax((a - 1) * middle.log() + (b - 1) * torch.log1p(-middle) + width.log(), 0)
        log_share = elastic + np.log(1 - RIGID)
        last = torch.logaddexp(log_share[-1:], torch.tensor([np.log(RIGID)], dtype=torch.float32))
        log_share = torch.cat([log_share[:-1], last])
        return torch.logsumexp(log_share - self.rate.exp() * energy.clamp(min=0), -1).double()

    def log_densities(self, e: Tensors) -> tuple[torch.Tensor, torch.Tensor]:
        """At the true poses (t,), and at all others (t, n), of t touches. The true poses count for the evidence like one more
        pose, so that a gain is bounded by what the poses can show."""
        at, truly = self.log_likelihood(e.energy), self.log_likelihood(e.true_energy)
        n, log_weight = at.shape[1], F.log_softmax(self.weight, 0)
        true, others = [], []
        for power, weight in zip(POWERS, log_weight, strict=True):
            each = power * at + (1 - power) * e.log_coarse
            one = power * truly + (1 - power) * e.true_log_coarse
            drawn = torch.cat([each - e.log_density, (one - e.true_log_density)[:, None]], 1)
            evidence = torch.logsumexp(drawn, 1) - np.log(n + 1) if power > 0 else torch.zeros(len(at))
            true.append(weight + one - evidence)
            others.append(weight + each - evidence[:, None])
        return torch.logsumexp(torch.stack(true), 0), torch.logsumexp(torch.stack(others), 0)


def fit(examples: Sequence[Example], progress: Progress | None = None) -> Fit:
    """Climb the mean log density at the true poses."""
    tensors, model = Tensors.of(examples), _Model()
    optimiser = torch.optim.Adam(model.parameters(), _RATE)
    for step in range(_STEPS):
        for group in optimiser.param_groups:
            group["lr"] = _RATE * (1 - step / _STEPS)
        optimiser.zero_grad()
        loss = -model.log_densities(tensors)[0].mean()
        loss.backward()
        optimiser.step()
        if progress:
            progress((step + 1) / _STEPS, "fitting")
    with torch.no_grad():
        true, others = model.log_densities(tensors)
        mass = torch.softmax(others - tensors.log_density, 1)
        level = (mass * (others > true[:, None])).sum(1).numpy()
        elastic = np.array([e.elastic for e in examples])
        return Fit(
            float(model.rate.exp()),
            tuple(model.share.exp().tolist()),
            tuple(F.softmax(model.weight, 0).tolist()),
            float(true.mean()),
            float((mass * others).sum(1).mean()),
            tuple(
                tuple(float((level[some] <= q).mean()) for q in LEVELS)
                for some in (np.ones_like(elastic), ~elastic, elastic)
            ),
        )


def fit_likelihood(
    out: Path, folder: Path, objects: int, touches: int, seed: int, progress: Progress | None = None
) -> Fit:
    """Make examples in ``folder``, fit the settings to them and write these to ``out``."""
    found = fit(make_examples(folder, objects, touches, seed, progress), progress)
    settings = {"objects": objects, "touches": touches, "seed": seed, "contacts": CONTACTS, "max_poses": MAX_POSES}
    content = {"schema": SCHEMA, "settings": settings, "sensors": SENSORS, "powers": POWERS, **asdict(found)}
    write_text(out, json.dumps(content | {"versions": versions()}, indent=1) + "\n")
    return found
