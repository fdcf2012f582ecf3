"""Trains the thesis's network for one object (6.1.4): pairs of simulated contacts, labelled by the distance of their poses."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from geomtact.contact_space.space import ContactSpace
from geomtact.errors import GeomtactError
from geomtact.geometry.distance import PoseDistance
from geomtact.progress import Progress
from geomtact.scoring.encoder import THESIS
from geomtact.scoring.precision import autocast
from geomtact.scoring.resnet import SIDE, encode, make_network, resized
from geomtact.se3 import Array, exp
from geomtact.training.card import write_network
from geomtact.training.state import not_a_number, resume, save_state, whose

SCHEMA = "geomtact/resnet50/1"
NEAR, FAR = 5e-3, 20e-3  # m: pose distance of positive pairs at most, of negative pairs at least
SLACK = 0.3  # a similarity up to which a negative pair costs nothing
_CAST = (48, 64)  # pixels of the simulated contacts
_SAVE_EVERY = 50
_PURPOSE = 6_1_4  # beside the seed: an evaluation with the same seed draws other poses


@dataclass(frozen=True)
class Settings:
    """The thesis's own, but for ``side`` [px], which it does not state."""

    pairs: int = 100_000
    batch: int = 32
    rate: float = 0.005
    momentum: float = 0.3
    weight_decay: float = 0.001
    side: int = SIDE
    seed: int = 0


@dataclass(frozen=True)
class Pairs:
    """Contacts ``left``, ``right`` (n, h, w) bool of pairs of poses, and their ``label`` (n,): how alike they are."""

    left: NDArray[np.bool_]
    right: NDArray[np.bool_]
    label: NDArray[np.float32]


def make_pairs(space: ContactSpace, n: int, seed: int = 0, progress: Progress | None = None) -> Pairs:
    """``n`` pairs, in turn positive (label 1 to 0.9, by the distance of the poses) and negative (label 0)."""
    rng = np.random.default_rng([_PURPOSE, seed])
    distance = PoseDistance(space.mesh)
    left: list[NDArray[np.bool_]] = []
    right: list[NDArray[np.bool_]] = []
    label: list[float] = []
    while len(label) < n:
        A, _ = space.sample(256, rng)
        near = A[::2] @ _small_motions(len(A[::2]), space.mesh.radius_rms, rng)
        B = np.empty_like(A)
        B[::2], B[1::2] = near, rng.permutation(A)[: len(A[1::2])]
        d = np.array([distance.mean(a, b[None])[0] for a, b in zip(A, B, strict=True)])
        positive = np.arange(len(A)) % 2 == 0
        ok = np.where(positive, d < NEAR, d > FAR) & np.isfinite(space.penetration(B))
        both = np.flatnonzero(ok & positive), np.flatnonzero(ok & ~positive)
        kept = np.stack([some[: min(map(len, both))] for some in both], 1).ravel()
        left.extend(space.caster.depths(space.sensor, A[kept], _CAST) > 0)
        right.extend(space.caster.depths(space.sensor, B[kept], _CAST) > 0)
        label.extend(np.where(positive, 1 - 0.1 * d / NEAR, 0)[kept])
        if progress:
            progress(min(len(label) / n, 1.0), "simulating pairs")
    return Pairs(np.stack(left[:n]), np.stack(right[:n]), np.array(label[:n], np.float32))


def pair_loss(similarity: torch.Tensor, label: torch.Tensor) -> torch.Tensor:
    """The thesis's Eq. 1: squared error, but nothing for a negative pair (label 0) up to a similarity of 0.3."""
    loss = (label - similarity) ** 2
    return torch.where((label == 0) & (similarity <= SLACK), torch.zeros_like(loss), loss)


def train_thesis(
    space: ContactSpace, settings: Settings, folder: Path, out: Path, progress: Progress | None = None
) -> None:
    """Train for the object of ``space`` and write the weights to ``out``, with a card beside it; ``folder`` keeps the state.

    Raises
    ------
    GeomtactError
        The loss is not a number any more.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    torch.manual_seed(settings.seed)
    network = make_network().to(device)
    optimizer = torch.optim.SGD(
        network.parameters(), settings.rate, momentum=settings.momentum, weight_decay=settings.weight_decay
    )
    pairs = make_pairs(space, settings.pairs, settings.seed, progress)
    steps = settings.pairs // settings.batch
    order = np.random.default_rng(settings.seed).permutation(settings.pairs)
    first, curve = resume(folder, network, optimizer, asdict(settings))
    losses: list[float] = [] if curve is None else curve["loss"]
    network.train()
    for step in range(first, steps):
        some = order[step * settings.batch :][: settings.batch]
        masks = np.concatenate([pairs.left[some], pairs.right[some]])
        images = torch.from_numpy(resized(masks, settings.side)).to(device)
        with autocast(device):
            vectors = encode(network, images)
        a, b = vectors.float().chunk(2)
        similarity = F.cosine_similarity(a, b).clamp(min=0)
        loss = pair_loss(similarity, torch.from_numpy(pairs.label[some]).to(device)).mean()
        if not torch.isfinite(loss):
            raise GeomtactError(not_a_number(folder, step))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
        if (step + 1) % _SAVE_EVERY == 0 or step + 1 == steps:
            save_state(folder, network, optimizer, asdict(settings), step + 1, {"loss": losses})
        if progress:
            progress((step + 1) / steps, f"training ResNet-50, loss {np.mean(losses[-50:]):.4f}")
    meta = {"architecture": THESIS, "side": str(settings.side), **whose(space.mesh, space.sensor)}
    card = {
        **meta,
        "settings": asdict(settings),
        "device": device,
        "loss": [float(np.mean(part)) for part in np.array_split(losses, min(50, len(losses)))],
    }
    write_network(out, network.cpu(), SCHEMA, card, meta)


def _small_motions(n: int, radius: float, rng: np.random.Generator) -> Array:
    """Motions (n, 4, 4) of the object in its own frame of up to about ``NEAR`` in mean point distance."""
    xi = rng.normal(size=(n, 6)) * np.repeat([1 / radius, 1.0], 3)
    size = NEAR * rng.random((n, 1)) / np.sqrt(6)
    return exp(xi * size)
