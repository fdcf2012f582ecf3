"""Sensor noise for training: what a real gel and camera do to a contact that a simulation does not show.

Every augmentation takes masks (n, 1, h, w), 0 or 1, the pixel [m] and a generator, and draws its strength for every
mask; only how far the outline's warp is correlated is drawn once a batch, and the blur is cut off at four pixels. The
elastic shrink, the unknown penetration and the shifts, turns and tilts below the grid's step are not here: they come
with the scenes, as touches solved with an elastic gel at poses drawn within the cells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import kornia
import torch
import torch.nn.functional as F

Augment = Callable[[torch.Tensor, float, torch.Generator], torch.Tensor]


@dataclass(frozen=True)
class Augmentation:
    """One kind of noise: its name, the range it is drawn from, why it is there, and what it does to a batch."""

    name: str
    range: str
    reason: str
    apply: Augment


def augmented(masks: torch.Tensor, pixel: float, rng: torch.Generator) -> torch.Tensor:
    """``masks`` (n, 1, h, w) with all noises of ``AUGMENTATIONS``; one that nothing is left of stays as it was."""
    out = masks
    for augmentation in AUGMENTATIONS:
        out = augmentation.apply(out, pixel, rng)
    kept = out.sum((1, 2, 3), keepdim=True) > 0
    return torch.where(kept, out, masks)


def _uniform(n: int, low: float, high: float, rng: torch.Generator) -> torch.Tensor:
    return low + (high - low) * torch.rand(n, generator=rng)


def _pitch(x: torch.Tensor, pixel: float, rng: torch.Generator) -> torch.Tensor:
    n, _, h, w = x.shape
    scale = 1 + 0.02 * torch.randn(n, 2, generator=rng).clamp(-2, 2)
    middle = torch.tensor([[(w - 1) / 2, (h - 1) / 2]]).expand(n, 2)
    M = kornia.geometry.transform.get_affine_matrix2d(torch.zeros(n, 2), middle, scale, torch.zeros(n))
    return _binary(kornia.geometry.transform.warp_affine(x, M[:, :2], (h, w), padding_mode="border"))


def _outline(x: torch.Tensor, pixel: float, rng: torch.Generator) -> torch.Tensor:
    n, _, h, w = x.shape
    correlation = float(_uniform(1, 0.6e-3, 4e-3, rng)) / pixel
    nodes = (max(3, round(1.5 * h / correlation) + 1), max(4, round(1.5 * w / correlation) + 1))
    field = torch.randn(n, 2, *nodes, generator=rng)
    field = F.interpolate(field, size=(h, w), mode="bicubic", align_corners=True)
    field = field / field.std((2, 3), keepdim=True)
    field = field * (_uniform(n, 0, 0.5e-3, rng) / pixel)[:, None, None, None]
    y, x_ = torch.meshgrid(torch.arange(h).float(), torch.arange(w).float(), indexing="ij")
    return _binary(kornia.geometry.transform.remap(x, x_ + field[:, 0], y + field[:, 1], padding_mode="border"))


def _boundary(x: torch.Tensor, pixel: float, rng: torch.Generator) -> torch.Tensor:
    n = len(x)
    sigma = _uniform(n, 0.2e-3, 1e-3, rng) / pixel
    soft = kornia.filters.gaussian_blur2d(x, (9, 9), torch.stack([sigma, sigma], 1))
    level = _uniform(n, 0.3, 0.7, rng)[:, None, None, None]
    return (soft > level).to(x)


def _dropout(x: torch.Tensor, pixel: float, rng: torch.Generator) -> torch.Tensor:
    n, _, h, w = x.shape
    area = x.sum((1, 2, 3))
    # a centre on the contact: the largest of uniform numbers masked by it
    at = (x.flatten(1) * torch.rand(n, h * w, generator=rng)).argmax(1)
    radius = _uniform(n, 0.1, 0.4, rng) * torch.sqrt(area / torch.pi) * (torch.rand(n, generator=rng) < 0.3)
    return x * ~_disks(at // w, at % w, radius, h, w)


def _speckle(x: torch.Tensor, pixel: float, rng: torch.Generator) -> torch.Tensor:
    share = _uniform(len(x), 0, 0.03, rng) * (torch.rand(len(x), generator=rng) < 0.2)
    flipped = torch.rand(x.shape, generator=rng) < share[:, None, None, None]
    return torch.where(flipped, 1 - x, x)


def _dust(x: torch.Tensor, pixel: float, rng: torch.Generator) -> torch.Tensor:
    n, _, h, w = x.shape
    out = x
    for _ in range(4):
        some = torch.rand(n, generator=rng) < 0.5
        row, column = (torch.randint(0, size, (n,), generator=rng) for size in (h, w))
        radius = _uniform(n, 0.1e-3, 0.25e-3, rng) / pixel * some
        out = torch.maximum(out, _disks(row, column, radius, h, w).to(x))
    return out


def _window(x: torch.Tensor, pixel: float, rng: torch.Generator) -> torch.Tensor:
    n, _, h, w = x.shape
    reach = _uniform(n, 0, 0.12, rng) * (torch.rand(n, generator=rng) < 0.1)
    side = torch.randint(0, 4, (n,), generator=rng)
    y, x_ = torch.meshgrid((torch.arange(h) + 0.5) / h, (torch.arange(w) + 0.5) / w, indexing="ij")
    from_side = torch.stack([y, 1 - y, x_, 1 - x_])[side]
    return x * (from_side >= reach[:, None, None])[:, None]


def _disks(row: torch.Tensor, column: torch.Tensor, radius: torch.Tensor, h: int, w: int) -> torch.Tensor:
    """Disks (n, 1, h, w) bool about pixels, none where the radius [px] is 0."""
    y, x = torch.arange(h)[None, :, None], torch.arange(w)[None, None, :]
    far = (y - row[:, None, None]) ** 2 + (x - column[:, None, None]) ** 2
    return ((far <= radius[:, None, None] ** 2) & (radius > 0)[:, None, None])[:, None]


def _binary(x: torch.Tensor) -> torch.Tensor:
    return (x > 0.5).to(x)


AUGMENTATIONS = (
    Augmentation(
        "pitch error", "2 % rms along x and y", "a pitch measured by hand is off by a per cent or two", _pitch
    ),
    Augmentation(
        "outline warp",
        "0 to 0.5 mm rms, 0.6 to 4 mm correlation",
        "gel, friction and reader move the rim smoothly",
        _outline,
    ),
    Augmentation(
        "soft boundary",
        "blur 0.2 to 1 mm, threshold 0.3 to 0.7",
        "where a reader sets the rim on a soft slope",
        _boundary,
    ),
    Augmentation(
        "dropout",
        "in 30 %, a patch of 0.1 to 0.4 of the contact's radius",
        "glare, wear, a reader that loses flats",
        _dropout,
    ),
    Augmentation(
        "speckle", "in 20 %, up to 3 % of the pixels flip", "a threshold near the image's own noise", _speckle
    ),
    Augmentation("dust", "0 to 4 specks of 0.2 to 0.5 mm", "dirt on the gel reads as contact", _dust),
    Augmentation(
        "partial window", "in 10 %, up to 12 % of one side is dead", "vignettes and frames cover the border", _window
    ),
)
