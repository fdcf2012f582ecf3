"""The network that finds the contact in a change of colour: a small U-Net, trained on simulated tactile images alone.

Where a channel is as bright as it can be, its change gives no slope; near a lamp the same slope changes it more than far off. So
its input also holds how much of each pixel is blown out, and how the gel is lit at rest.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from safetensors.torch import load_file
from torch import nn

WEIGHTS = Path(__file__).with_name("mask_network.safetensors")
WIDTHS = (12, 24, 48, 64)  # channels, at each halving
# Residual blocks more at each, on the way down: where it is coarse, what is far apart is seen together
DEEPER = (0, 0, 1, 2)
_GROUPS = 4  # of channels that are normalised together
_SIDE = 60  # px of the shorter side of what it sees
_STEP = 8  # px that sides are multiples of: they are halved three times
CHANNELS = 9  # three of change, three of what is blown out, three of how bright it is at rest
_BLOWN_OUT = 0.98  # brightness from which on
# Standard deviation of the Gaussian that smooths its log odds [px of what it sees]: of 0.5 to 3 the best on simulated presses
# that it never saw, IoU 0.862 for 0.854 (by 0.003 to 0.013 more)
_SMOOTHING = 0.6

Image = NDArray[np.float32]


class MaskNetwork(nn.Module):
    """Log odds of contact at each pixel."""

    def __init__(self) -> None:
        super().__init__()
        self.down = nn.ModuleList([_block(a, b) for a, b in zip((CHANNELS, *WIDTHS), WIDTHS, strict=False)])
        self.deeper = nn.ModuleList(
            [nn.Sequential(*map(_Residual, n * (w,))) for w, n in zip(WIDTHS, DEEPER, strict=True)]
        )
        pairs = list(zip(WIDTHS, WIDTHS[1:], strict=False))
        self.up = nn.ModuleList([_block(a + b, a) for a, b in reversed(pairs)])
        self.out = nn.Conv2d(WIDTHS[0], 1, 1)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Log odds (n, h, w) of what is :func:`seen` (n, ``CHANNELS``, h, w)."""
        h, w = images.shape[-2:]
        passed, x = [], F.pad(images, (0, -w % _STEP, 0, -h % _STEP))
        for i, (block, deeper) in enumerate(zip(self.down, self.deeper, strict=True)):
            x = deeper(block(F.avg_pool2d(x, 2) if i else x))
            passed.append(x)
        for block, beside in zip(self.up, reversed(passed[:-1]), strict=True):
            x = block(torch.cat([F.interpolate(x, scale_factor=2.0, mode="nearest"), beside], 1))
        out: torch.Tensor = self.out(x)[:, 0, :h, :w]
        return out


class _Residual(nn.Module):
    """Adds to what it sees; nothing, before it is trained."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.before, self.after = (
            nn.Sequential(nn.GroupNorm(_GROUPS, width), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1))
            for _ in range(2)
        )
        nn.init.zeros_(self.after[-1].weight)  # type: ignore[arg-type]
        nn.init.zeros_(self.after[-1].bias)  # type: ignore[arg-type]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = x + self.after(self.before(x))
        return out


def contact_probability(change: ArrayLike, image: ArrayLike) -> Image:
    """Probability (H, W) of contact at each pixel, of a ``change`` of colour (H, W, 3) of an ``image`` (H, W, 3) 0..1 from its
    background, RGB: the mean log odds of all looks, so that it turns and is mirrored as the image is."""
    x = torch.from_numpy(seen(change, image))
    upright = x.shape[1] > x.shape[2]
    x = x.rot90(1, (1, 2)) if upright else x
    looks = _looks(x.shape[1] == x.shape[2])
    shown = torch.stack([_turned(x, turns, mirrored) for turns, mirrored in looks])
    with torch.inference_mode():
        found = _network()(shown.contiguous(memory_format=torch.channels_last))
    log_odds = torch.stack([_turned_back(y, *look) for y, look in zip(found, looks, strict=True)]).mean(0)
    log_odds = log_odds.rot90(-1) if upright else log_odds
    full = cv2.resize(smoothed(log_odds.numpy()), np.shape(change)[1::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(1 / (1 + np.exp(-full)), np.float32)


def _looks(square: bool) -> list[tuple[int, bool]]:
    """Quarter turns, and whether mirrored before, that leave the sides of an image as long as they are."""
    return [(turns, mirrored) for turns in range(0, 4, 1 if square else 2) for mirrored in (False, True)]


def _turned(x: torch.Tensor, turns: int, mirrored: bool) -> torch.Tensor:
    return (x.flip(-1) if mirrored else x).rot90(turns, (-2, -1))


def _turned_back(x: torch.Tensor, turns: int, mirrored: bool) -> torch.Tensor:
    x = x.rot90(-turns, (-2, -1))
    return x.flip(-1) if mirrored else x


def smoothed(log_odds: Image) -> Image:
    """``log_odds`` (h, w) of the network, smoothed: they tremble from one pixel to the next, an outline does not."""
    return np.asarray(cv2.GaussianBlur(log_odds, (0, 0), _SMOOTHING))


def seen(change: ArrayLike, image: ArrayLike) -> Image:
    """What the network sees (``CHANNELS``, h, w) of a change of colour (H, W, 3) in an ``image`` (H, W, 3) 0..1: all smaller,
    the change in shares of what hardly any pixel exceeds."""
    image = np.asarray(image, np.float32)
    small = to_side(np.asarray(change, np.float32))
    strongest = float(np.quantile(np.linalg.norm(small, axis=-1), 0.98))
    blown_out = to_side((image >= _BLOWN_OUT).astype(np.float32))
    all_of_it = [small / max(strongest, 1e-6), blown_out, to_side(image) - small]
    return np.ascontiguousarray(np.concatenate(all_of_it, -1).transpose(2, 0, 1))


def to_side(image: Image) -> Image:
    """``image`` (H, W, ...) as small as the network sees it: the mean of what falls into each pixel."""
    h, w = side_shape(image.shape)
    return np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA))


def side_shape(shape: tuple[int, ...]) -> tuple[int, int]:
    """How many pixels (h, w) the network sees of an image of ``shape`` (H, W, ...)."""
    scale = _SIDE / min(shape[:2])
    return round(shape[0] * scale), round(shape[1] * scale)


@lru_cache(maxsize=1)
def _network() -> MaskNetwork:
    network = MaskNetwork()
    network.load_state_dict({name: value.float() for name, value in load_file(WEIGHTS).items()})
    return network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]  # faster by half


def _block(before: int, after: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for a, b in ((before, after), (after, after)):
        layers += [nn.Conv2d(a, b, 3, padding=1), nn.GroupNorm(_GROUPS, b), nn.SiLU()]
    return nn.Sequential(*layers)
