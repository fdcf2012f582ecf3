"""Fits the weights of the powers of the likelihood that a posterior mixes, as functions of how long the contact's outline is.

Touches of procedural objects, on any side or a known face, on rigid and elastic gels, with noise of any strength up to heavy, are
explored by the sampler as it is. What each power makes of the true pose, averaged over the errors that a whole contact has in
common, says how to weigh it: the weights maximise the mean log density at the true poses ("covariate-dependent stacking", Yao et
al. 2022). Half of the contacts are found in tactile images under random lamps: these have weights of their own.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import log_softmax, logsumexp

from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.touch import CALIBRATION_NOISE, draw_noise, simulate_depth_map, simulate_mask, spoilt
from geomtact.contact_space.touches import Touch, counts, each_touch
from geomtact.files import write_text
from geomtact.geometry.mesh import Mesh
from geomtact.inference.particles import poses_of
from geomtact.inference.sampler import Run, explore
from geomtact.inference.systematic_errors import random_errors
from geomtact.inference.two_runs import pooled
from geomtact.localizer import Localizer
from geomtact.progress import Progress
from geomtact.scoring.contact_likelihood import POWERS, SCALE_ERROR, SHIFT_ERROR, ContactQuery, from_outline
from geomtact.se3 import Array
from geomtact.sensing.change import GRID
from geomtact.sensing.local_shape import contact_of
from geomtact.sensing.noise import CLEAN, MODERATE
from geomtact.versions import versions
from tools.training.examples import SENSORS, drawn_object, resumed
from tools.training.presses import THICKNESS
from tools.training.tactile_images import random_reading

SIZES = (0.5, 5.0)  # longest side of an object, in long sides of the window
FACES = 3  # one object of so many is touched on a known face
MAX_POSES = 400_000  # of the grid
CONTACTS, REFERENCE = 10_000, 80_000  # of the sampler, and of the run that says how far its density is off
KEPT = 80  # poses of each posterior, at most
_LARGER = 0.01  # objects are as much larger or smaller than their meshes, at most
_SCALE = 0.02  # pixels are as much larger or smaller than stated, at most
_WITHIN = -0.1e-3, 0.2e-3  # m: by how much the outline of a mask lies too far in or out, at most
_IMAGES = 0.5  # share of contacts that are found in tactile images
_OVERLAP = 0.5  # least overlap (IoU) of a contact found in one with the true one; of 89 real images the least is 0.70
_LONGEST, _OF = 0.5, 4  # share of touches whose contact is the largest of so many
_PENALTY = 1e-3  # of the square of a slope, beside a mean log density
_LEAST = -60.0  # nats: a lower log density at a true pose is as bad as this

_SINGLE = ("log_outline", "elastic", "in_image")

SCHEMA = "geomtact/mixture/5"
LEVELS = (0.5, 0.8, 0.9, 0.95)


@dataclass(frozen=True, eq=False)
class Example:
    """One touch, explored.

    Attributes
    ----------
    at_truth : (K,) log density at the true pose by each of ``POWERS``
    at_particles : (n, K) at poses of all powers that are in the contact pose space
    sizes : (K,) how many of these each has
    inside : (K,) which share of its poses that is
    excess : (K,) log of the integral of each density, by the evidence of a run with ``REFERENCE`` contacts
    log_outline : log of the outline's length over ``OUTLINE``
    elastic : whether the gel of a mask was; that of an image always is, whatever this says
    in_image : whether the contact was found in a tactile image
    """

    at_truth: Array
    at_particles: Array
    sizes: Array
    inside: Array
    excess: Array
    log_outline: float
    elastic: bool
    in_image: bool


def make_examples(
    folder: Path, objects: int, touches: int, seed: int, progress: Progress | None = None
) -> list[Example]:
    """``touches`` of each of so many ``objects``, in files of ``folder``, so that a stopped run goes on."""
    paths = [folder / f"touches-{i}.npz" for i in range(objects)]
    return resumed(paths, lambda i: _examples_of(i, touches, seed), _save, _load, progress)


def _examples_of(i: int, touches: int, seed: int) -> Iterator[Example]:
    rng = np.random.default_rng([seed, i])
    sensor, mesh = drawn_object(i, SIZES, rng)
    face = [(np.eye(3)[rng.integers(3)] * rng.choice([-1, 1]), 0.0)] if i % FACES == FACES - 1 else None
    localizer = Localizer.prepare(mesh, sensor=sensor, approach=face, max_poses=MAX_POSES)
    for touch, in_image in _touches(localizer, touches, rng):
        query = ContactQuery.of(touch.mask, sensor, "image" if in_image else "mask")
        coarse = np.exp(localizer.scorer.log_mass(localizer.index, touch.mask)).sum(0)
        run = pooled(*explore(localizer.index, query, coarse, CONTACTS // 2, rng, runs=2), len(POWERS) - 1, rng)
        (reference,) = explore(localizer.index, query, coarse, REFERENCE, rng)
        yield _example(run, reference, touch, in_image, rng)


def _touches(localizer: Localizer, n: int, rng: np.random.Generator) -> Iterator[tuple[Touch, bool]]:
    """Up to ``n`` touches, and whether the contact was found in an image; without those that show less than 1 mm^2 of contact,
    or whose image hardly shows it.

    Half of them are as the localizer expects them: masks have moderate noise. Of the others, masks have noise of any strength up
    to heavy, and objects, pixels and the outlines of masks are off. Half of them are the largest of a few touches: else hardly
    any would have a long outline, and the weights depend on it.
    """
    space = localizer.space
    drawn = each_touch(space, _OF * n, int(rng.integers(1 << 31)), noise=CLEAN)
    for number in range(n):
        some = list(islice(drawn, _OF))
        touch = max(some, key=lambda each: int(each.mask.sum())) if rng.random() < _LONGEST else some[number % _OF]
        as_expected = number % 4 < 2  # rigid and elastic ones alike
        size = 0.0 if as_expected else rng.random()  # of errors, of the largest
        mesh = larger(space.mesh, 1 + size * rng.uniform(-_LARGER, _LARGER))
        pressed, T, in_image = ContactSpace(mesh, space.sensor), touch.T_sensor_object, rng.random() < _IMAGES
        true = simulate_mask(pressed, T, touch.elastic)
        mask = _found(pressed, T, rng) if in_image else true
        if (mask & true).sum() < _OVERLAP * (mask | true).sum():
            continue
        mask = _scaled(mask, 1 + size * rng.uniform(-_SCALE, _SCALE))
        if not in_image:
            off = size * rng.uniform(*_WITHIN)
            mask = from_outline(mask, float(np.sqrt(space.sensor.pixel_area(mask.shape)))) < off
            mask = spoilt(mask, space, MODERATE if as_expected else draw_noise(CALIBRATION_NOISE, rng), rng)
        if counts(space, mask):
            yield replace(touch, mask=mask), in_image


def _found(space: ContactSpace, T: Array, rng: np.random.Generator) -> NDArray[np.bool_]:
    """The contact (H, W) with the object at ``T`` (4, 4), as it is found in an image of a gel of random thickness under random
    lamps."""
    sensor = space.sensor
    shape = sensor.along((GRID, round(GRID * max(sensor.image_size_px) / min(sensor.image_size_px))))
    thickness = float(np.exp(rng.uniform(*np.log(THICKNESS))))
    height = simulate_depth_map(space, T, True, thickness, shape)
    pitch = np.sqrt(sensor.pixel_area(shape))
    at_rest = -sensor.lift(np.stack(np.meshgrid(*sensor.pixel_centres(shape)), -1))[..., 2]
    image, background = random_reading(height / pitch, rng, at_rest / pitch)
    found = contact_of(image, background, "learned", np.asarray(sensor.pixel_pitch) / min(sensor.pixel_pitch)).mask
    size = sensor.image_size_px
    return np.asarray(cv2.resize(found.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5)


def larger(mesh: Mesh, by: float) -> Mesh:
    """``mesh`` enlarged ``by`` a factor about its centre."""
    return replace(mesh, vertices=mesh.centre + by * (mesh.vertices - mesh.centre))


def _scaled(mask: NDArray[np.bool_], by: float) -> NDArray[np.bool_]:
    """``mask`` (H, W) enlarged ``by`` a factor about its middle."""
    height, width = mask.shape
    moved = cv2.getRotationMatrix2D((0.5 * (width - 1), 0.5 * (height - 1)), 0, by)
    image, size = 255 * mask.astype(np.uint8), (width, height)
    return np.asarray(cv2.warpAffine(image, moved, size, borderMode=cv2.BORDER_REPLICATE) > 127)


def _example(run: Run, reference: Run, touch: Touch, in_image: bool, rng: np.random.Generator) -> Example:
    density, target = run.density, run.density.target
    at_particles, sizes, inside = [], [], []
    for particles in run.particles:
        some = particles.take(rng.permutation(len(particles))[:KEPT])
        poses = poses_of(some.poses, some.depth, target.index.mesh.centre)
        poses = target.displaced(poses, random_errors(len(some), rng))
        poses = poses[np.isfinite(target.particles_at(poses).log_likelihood)]
        at_particles.append(density.of_powers(poses))
        sizes.append(len(poses))
        inside.append(len(poses) / len(some))
    return Example(
        density.of_powers(touch.T_sensor_object)[0],
        np.concatenate(at_particles),
        np.array(sizes),
        np.array(inside),
        np.subtract(reference.log_evidence, run.log_evidence),
        target.query.log_outline,
        touch.elastic,
        in_image,
    )


def _save(path: Path, examples: Sequence[Example]) -> None:
    n = max(len(e.at_particles) for e in examples)
    padded = [np.pad(e.at_particles, ((0, n - len(e.at_particles)), (0, 0))) for e in examples]
    columns = {
        name: np.stack([getattr(e, name) for e in examples]) for name in ("at_truth", "sizes", "inside", "excess")
    }
    single = {name: np.array([getattr(e, name) for e in examples]) for name in _SINGLE}
    with open(path, "wb") as file:
        np.savez(file, allow_pickle=False, at_particles=np.stack(padded).astype(np.float32), **columns, **single)


def _load(path: Path) -> list[Example]:
    with np.load(path, allow_pickle=False) as data:
        rows = zip(*(data[name] for name in Example.__dataclass_fields__), strict=True)
        return [
            Example(t, p[: s.sum()].astype(float), s, i, x, float(o), bool(e), bool(b))
            for t, p, s, i, x, o, e, b in rows
        ]


@dataclass(frozen=True)
class Fit:
    """Fitted weights, and how well they do on the touches they are fitted to.

    Attributes
    ----------
    intercept, slope : (K,) the weights are the softmax of intercept + slope log(outline / OUTLINE)
    n : touches
    gain, expected_gain : means [nats] of the density divided by its integral, at the true poses, where it is at most that of the
        densest particle, and under the posteriors themselves
    coverage : share of the touches whose true pose is in the regions of ``LEVELS``: of all, rigid, elastic ones
    """

    intercept: tuple[float, ...]
    slope: tuple[float, ...]
    n: int
    gain: float
    expected_gain: float
    coverage: tuple[tuple[float, ...], ...]


def fit(examples: Sequence[Example]) -> Fit:
    """The weights that maximise the mean log density at the true poses, divided by its integral."""
    truth = np.maximum(np.stack([e.at_truth for e in examples]), _LEAST)
    outline = np.array([e.log_outline for e in examples])
    inside = np.stack([e.inside for e in examples])
    excess = np.stack([e.excess for e in examples])
    k = truth.shape[1]

    def log_weights(z: Array) -> Array:
        """(t, K) of every touch."""
        intercept, slope = np.append(z[: k - 1], 0), np.append(z[k - 1 :], 0)
        return np.asarray(log_softmax(intercept + slope * outline[:, None], axis=1))

    def loss(z: Array) -> float:
        log_weight = log_weights(z)
        gain = logsumexp(truth + log_weight, axis=1) - logsumexp(log_weight + excess, axis=1, b=inside)
        # as if each power alone explained one touch more: no power is ruled out by those that were drawn
        return float(_PENALTY * (z[k - 1 :] ** 2).sum() - (gain.sum() + log_weight.mean(0).sum()) / len(gain))

    z = minimize(loss, np.zeros(2 * (k - 1)), method="L-BFGS-B").x
    gain, expected, level = [], [], []
    for e, log_weight in zip(examples, log_weights(z), strict=True):
        log_inside = logsumexp(log_weight, b=e.inside)
        density = logsumexp(e.at_particles + log_weight, axis=1) - log_inside
        mass = np.repeat(np.exp(log_weight - log_inside) * e.inside / np.maximum(e.sizes, 1), e.sizes)
        at_truth = min(logsumexp(e.at_truth + log_weight) - log_inside, density.max(initial=-np.inf))
        too_much = logsumexp(log_weight + e.excess, b=e.inside) - log_inside
        gain.append(float(at_truth - too_much))
        expected.append(float(mass @ density - too_much))
        level.append(float(mass @ (density > at_truth)))
    elastic = np.array([e.elastic for e in examples])
    return Fit(
        tuple(np.append(z[: k - 1], 0).tolist()),
        tuple(np.append(z[k - 1 :], 0).tolist()),
        len(examples),
        float(np.mean(gain)),
        float(np.mean(expected)),
        tuple(
            tuple(float((np.array(level)[some] <= q).mean()) for q in LEVELS)
            for some in (np.ones_like(elastic), ~elastic, elastic)
        ),
    )


def fit_mixture(
    out: Path, folder: Path, objects: int, touches: int, seed: int, progress: Progress | None = None
) -> dict[str, Fit]:
    """Make examples in ``folder``, fit the weights of masks and of images to them, and write these to ``out``."""
    examples = make_examples(folder, objects, touches, seed, progress)
    found = {source: fit([e for e in examples if e.in_image == (source == "image")]) for source in ("mask", "image")}
    settings = {
        "objects": objects,
        "touches": touches,
        "seed": seed,
        "contacts": CONTACTS,
        "reference": REFERENCE,
        "max_poses": MAX_POSES,
    }
    settings |= {"scale_error": SCALE_ERROR, "shift_error": SHIFT_ERROR}
    content = {"schema": SCHEMA, "settings": settings, "sensors": SENSORS, "powers": POWERS}
    fits = {source: asdict(each) for source, each in found.items()}
    write_text(out, json.dumps(content | fits | {"versions": versions()}, indent=1) + "\n")
    return found
