"""Trains the network that finds the contact in a change of colour, by cross entropy: its outputs are probabilities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from geomtact.errors import InputError
from geomtact.progress import Progress
from geomtact.sensing.mask_network import CHANNELS, MaskNetwork
from geomtact.training.card import write_network
from geomtact.training.state import begin_with, claim, descend, read_weights, resume, save_state, sha256_of, steps
from tools.training import presses, tactile_images
from tools.training.presses import Presses, make_presses

SCHEMA = "geomtact/mask-network/1"
_FIRST = "down.0.0.weight"  # of what the network sees


@dataclass(frozen=True)
class Settings:
    """What a run depends on, beside its presses."""

    steps: int = 6000
    batch: int = 32
    rate: float = 3e-3
    weight_decay: float = 1e-4
    validation: int = 40  # objects that are never trained on
    seed: int = 0


def train_contact_network(
    out: Path, work: Path, n: int, settings: Settings, start: Path | None = None, progress: Progress | None = None
) -> float:
    """Train on presses of ``n`` objects and write ``out`` and its card; the overlap (IoU) on objects never seen.

    ``work`` keeps the presses and the state; ``start`` names weights to begin with.
    """
    began, weights = sha256_of(start), None if start is None else read_weights(start)
    claim(work, {"architecture": "mask", "seed": settings.seed, "start": began})
    made = make_presses(work / "presses", n, settings.seed, progress)
    network, curve = train_mask(made, settings, work, progress, start=weights)
    write_mask_network(out, network, curve, settings, sum(len(p.seen) for p in made), began)
    return curve["validation"][-1]


def train_mask(
    parts: Sequence[Presses],
    settings: Settings,
    folder: Path,
    progress: Progress | None = None,
    check_every: int = 500,
    start: Mapping[str, torch.Tensor] | None = None,
) -> tuple[MaskNetwork, dict[str, list[float]]]:
    """Train on all ``parts`` but the last ``settings.validation``; a stopped run goes on from ``folder``. ``start`` holds weights
    to start from.

    Returns the network and its curve: cross entropy over the steps, and overlap (IoU) with the contact on objects never seen.

    Raises
    ------
    InputError
        Too few objects, or weights of another network to start from.
    GeomtactError
        The loss is not a number any more; the last good state stays in ``folder``.
    """
    if len(parts) <= settings.validation:
        raise InputError(
            f"training: expected more than {settings.validation} parts, got {len(parts)}; give more with --scenes"
        )
    (seen, contact), judged = (_tensors(p) for p in (parts[: -settings.validation], parts[-settings.validation :]))
    torch.manual_seed(settings.seed)
    network = MaskNetwork()
    if start is not None:
        begin_with(network, _grown(start, network))
    network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # twice as fast
    optimizer = torch.optim.AdamW(network.parameters(), lr=settings.rate, weight_decay=settings.weight_decay)
    first, curve = resume(folder, network, optimizer, asdict(settings))
    curve = curve or {"step": [], "training": [], "validation": []}
    losses: list[float] = []
    for step, rng in steps(optimizer, first, settings.steps, settings.rate, settings.seed):
        some = rng.integers(len(seen), size=settings.batch)
        which = rng.integers(seen.shape[1], size=settings.batch)
        x, y = _varied(seen[some, which].float(), contact[some].float(), rng)
        network.train()
        loss = F.binary_cross_entropy_with_logits(network(x), y)
        loss.backward()
        losses.append(float(loss.detach()))
        descend(network, optimizer, losses[-1], folder, step)
        if (step + 1) % check_every == 0 or step + 1 == settings.steps:
            curve["step"].append(step + 1)
            curve["training"].append(float(np.mean(losses)))
            curve["validation"].append(validate(network, *judged))
            losses = []
            save_state(folder, network, optimizer, asdict(settings), step + 1, curve)
        if progress:
            overlap = f", IoU {curve['validation'][-1]:.2f} on unseen parts" if curve["validation"] else ""
            progress((step + 1) / settings.steps, f"training the mask network{overlap}")
    return network.eval(), curve


def validate(network: MaskNetwork, seen: torch.Tensor, contact: torch.Tensor) -> float:
    """Median IoU of what is likelier in contact than not, unsmoothed, with what is, over the first image of each press."""
    network.eval()
    with torch.inference_mode():
        found = torch.cat([network(seen[i : i + 64, 0].float()) > 0 for i in range(0, len(seen), 64)])
    true = contact > 0.5
    either = (found | true).sum((1, 2)).clamp(min=1)
    return float(((found & true).sum((1, 2)) / either).median())


def write_mask_network(
    path: Path,
    network: MaskNetwork,
    curve: dict[str, list[float]],
    settings: Settings,
    n: int,
    start: str | None = None,
) -> None:
    """Write ``path`` (safetensors, half precision) and beside it the card (.json): ``n`` presses were trained on, drawn from what
    ``presses`` and ``tactile_images`` say; ``start`` is the SHA-256 of the weights that training began with."""
    drawn = {
        name.lower(): value
        for module in (presses, tactile_images)
        for name, value in vars(module).items()
        if name.isupper() and not name.startswith("_")
    }
    card = {
        "data": drawn | {"presses": n},
        "settings": asdict(settings),
        "start_sha256": start,
        "curve": curve,
    }
    write_network(path, network, SCHEMA, card)


def _tensors(parts: Sequence[Presses]) -> tuple[torch.Tensor, torch.Tensor]:
    """All that is seen (n, readings, ``CHANNELS``, h, w) and contacts (n, h, w) of ``parts``."""
    seen, contact = (np.concatenate([getattr(p, name) for p in parts]) for name in ("seen", "contact"))
    return torch.from_numpy(seen), torch.from_numpy(contact)


def _grown(weights: Mapping[str, torch.Tensor], network: MaskNetwork) -> dict[str, torch.Tensor]:
    """``weights``, those of a network that saw fewer channels or was less deep, too: what it lacks counts for nothing yet."""
    fresh = {name: value for name, value in network.state_dict().items() if name.startswith("deeper.")}
    out = fresh | dict(weights)
    first = out.get(_FIRST)
    if first is not None and first.ndim == 4 and first.shape[1] < CHANNELS:
        out[_FIRST] = F.pad(first, (0, 0, 0, 0, 0, CHANNELS - first.shape[1]))
    return out


def _varied(seen: torch.Tensor, contact: torch.Tensor, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Mirrored and turned by quarters, the colours exchanged: all of it is another gel with other lamps."""
    for axis in (-1, -2):
        if rng.random() < 0.5:
            seen, contact = seen.flip(axis), contact.flip(axis)
    if rng.random() < 0.5:
        seen, contact = seen.transpose(-1, -2), contact.transpose(-1, -2)
    order = torch.from_numpy(rng.permutation(3))
    change, *others = (seen[:, order + first] for first in range(0, CHANNELS, 3))
    strength = torch.from_numpy(rng.uniform(0.7, 1.4, (len(seen), 1, 1, 1))).float()
    return torch.cat([change * strength, *others], 1), contact
