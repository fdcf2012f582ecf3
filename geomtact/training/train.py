"""Trains the shared encoder: the cell that holds a touch is to get the largest posterior among all cells of its object.

The loss is minus the information gained about the true cell, in nats,

    loss = -( s_true - log sum_j w_j exp(s_j) ),    s_j = -|f(touch) - g(stored_j)|^2,

with the stored contacts j of the same object and the uniform measure w_j of their cells: noise-contrastive estimation with
the prior as noise (van den Oord et al. 2018). Its minimum is the true log likelihood, so what is learned is the score
that a posterior needs, for contacts that differ by as much as a grid cell lets them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from geomtact.contact_space.index import unpack
from geomtact.errors import InputError
from geomtact.progress import Progress
from geomtact.scoring.contact_features import SHAPE
from geomtact.scoring.network import Encoder
from geomtact.scoring.precision import autocast
from geomtact.sensing.moments import without_specks
from geomtact.training.augment import augmented
from geomtact.training.scenes import KEY_SHAPE, TOUCH_SHAPE, TrainingScene
from geomtact.training.state import begin_with, descend, resume, save_state, steps


@dataclass(frozen=True)
class Settings:
    """What a run depends on, beside its scenes."""

    steps: int = 4000
    scenes_a_step: int = 3
    touches: int = 160  # of a scene, at most; half of them on an elastic gel
    stored: int = 3000  # contacts of a scene that each touch is compared with, at most
    rate: float = 2e-3
    weight_decay: float = 1e-3
    width: int = 512
    dimension: int = 16
    validation: int = 40  # scenes that are never trained on
    seed: int = 0


@dataclass(frozen=True)
class Curve:
    """Gain [nats] over the steps: mean over the training touches since the last entry, and over the validation's."""

    step: list[int]
    training: list[float]
    validation: list[float]


def train(
    scenes: list[TrainingScene],
    settings: Settings,
    folder: Path,
    progress: Progress | None = None,
    check_every: int = 250,
    start: dict[str, torch.Tensor] | None = None,
) -> tuple[Encoder, Curve]:
    """Train on ``scenes``, all but the last ``settings.validation``; a stopped run goes on from ``folder``.

    ``start`` holds weights to start from, for fine-tuning. The same settings and scenes give the same weights.

    Raises
    ------
    InputError
        Too few scenes, or weights of another architecture to start from.
    GeomtactError
        The loss is not a number any more; the last good state stays in ``folder``.
    """
    if len(scenes) <= settings.validation:
        raise InputError(
            f"training: expected more than {settings.validation} scenes, got {len(scenes)}; give more with --scenes"
        )
    learned, held_out = scenes[: -settings.validation], scenes[-settings.validation :]
    torch.manual_seed(settings.seed)
    network = Encoder(settings.width, settings.dimension)
    if start is not None:
        begin_with(network, start)
    optimizer = torch.optim.AdamW(network.parameters(), lr=settings.rate, weight_decay=settings.weight_decay)
    curve = Curve([], [], [])
    first, earlier = resume(folder, network, optimizer, asdict(settings))
    if earlier is not None:
        curve = Curve(**earlier)  # type: ignore[arg-type]
    gains: list[float] = []
    for step, rng in steps(optimizer, first, settings.steps, settings.rate, settings.seed):
        network.train()
        for i in rng.integers(len(learned), size=settings.scenes_a_step):
            gain = scene_gain(network, learned[i], settings, rng)
            # one hopeless touch must not steer the step
            (-gain.clamp(min=-8).mean() / settings.scenes_a_step).backward()
            gains.append(float(gain.detach().mean()))
        descend(network, optimizer, -sum(gains[-settings.scenes_a_step :]), folder, step)
        if (step + 1) % check_every == 0 or step + 1 == settings.steps:
            curve.step.append(step + 1)
            curve.training.append(float(np.mean(gains)))
            curve.validation.append(validate(network, held_out, settings))
            gains = []
            save_state(folder, network, optimizer, asdict(settings), step + 1, asdict(curve))
        if progress:
            validated = f", {curve.validation[-1]:.2f} nats on unseen scenes" if curve.validation else ""
            progress((step + 1) / settings.steps, f"training the encoder{validated}")
    return network.eval(), curve


def validate(network: Encoder, scenes: list[TrainingScene], settings: Settings) -> float:
    """Mean gain [nats] on ``scenes``; the same touches and noise every time."""
    network.eval()
    rng = np.random.default_rng([settings.seed, 1 << 40])
    with torch.no_grad():
        return float(np.mean([scene_gain(network, s, settings, rng, flipped=False).mean() for s in scenes]))


def scene_gain(
    network: Encoder, scene: TrainingScene, settings: Settings, rng: np.random.Generator, flipped: bool = True
) -> torch.Tensor:
    """Information gained (t,) [nats] about the true cells of some touches of a scene."""
    touches, stored, true, log_w = _batch(scene, settings, rng, flipped)
    with autocast():
        cell = torch.from_numpy(scene.cell)
        f, g = network(touches, cell, "touch"), network(stored, cell, "stored")  # (t, d), (t + n, d)
    s = 2 * f @ g.T - (f * f).sum(1)[:, None] - (g * g).sum(1)  # (t, t + n)
    row = torch.arange(len(true))
    evidence: torch.Tensor = torch.logsumexp(s[:, len(true) :] + log_w, 1)
    return s[row, row] - evidence


def _batch(
    scene: TrainingScene, settings: Settings, rng: np.random.Generator, flipped: bool
) -> tuple[torch.Tensor, torch.Tensor, NDArray[np.int64], torch.Tensor]:
    """Touches (t, 24, 32), their own stored contacts and others (t + n, 24, 32), the former's ids, the latter's log weights."""
    kinds = [np.flatnonzero(scene.elastic == elastic) for elastic in (False, True)]
    some = np.concatenate([rng.permutation(kind)[: settings.touches // 2] for kind in kinds])
    noise = torch.Generator().manual_seed(int(rng.integers(1 << 62)))
    noisy = augmented(_unpacked(scene.touches[some], TOUCH_SHAPE)[:, None], scene.pixel, noise)
    # from here on as an observed contact goes: specks are left out, and pixels are shares of contact
    seen = np.stack([without_specks(mask, scene.pixel**2) for mask in noisy[:, 0].numpy() > 0.5])
    touches = F.avg_pool2d(torch.from_numpy(seen).float()[:, None], TOUCH_SHAPE[0] // SHAPE[0])[:, 0]
    true = scene.true[some]
    others = rng.choice(len(scene.weight), min(settings.stored, len(scene.weight)), replace=False)
    stored = _unpacked(scene.stored[np.concatenate([true, others])], KEY_SHAPE)
    for axis in (-1, -2):  # a mirrored object is an object
        if flipped and rng.random() < 0.5:
            touches, stored = touches.flip(axis), stored.flip(axis)
    weight = scene.weight[others]
    return touches, stored, true, torch.from_numpy(np.log(np.maximum(weight / weight.sum(), 1e-12)))


def _unpacked(words: NDArray[np.uint64], shape: tuple[int, int]) -> torch.Tensor:
    return torch.from_numpy(unpack(words, shape)).float()
