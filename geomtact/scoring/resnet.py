"""The thesis's similarity network (6.1.4), the baseline: a ResNet-50 trained for one object, contacts compared by cosine.

The thesis does not say how the last feature map becomes 1,000 numbers, nor at which size images go in: here it is averaged
over the image and multiplied by one matrix, and images are 224 x 224 unless the weights were trained at another size.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from geomtact.errors import InputError
from geomtact.scoring.encoder import THESIS
from geomtact.scoring.precision import autocast
from geomtact.scoring.vectors import VectorScorer
from geomtact.sensing.contact import SoftMask
from geomtact.sensing.sensor import Sensor

SIDE, NUMBERS = 224, 1000
_BLOCKS = (3, 4, 6, 3)  # of each stage
_BATCH = 64


@dataclass(frozen=True, eq=False)
class Resnet:
    """The network as a descriptor: 1,000 numbers of unit length, 4,000 bytes a pose."""

    network: nn.Module
    side: int
    digest: str
    name: str = THESIS

    def __repr__(self) -> str:
        return f"Resnet({self.side}, {self.digest})"

    def describe(self, masks: NDArray[np.bool_], sensor: Sensor) -> NDArray[np.float32]:
        """Unit vectors (m, 1000) of masks (m, h, w)."""
        images = resized(masks, self.side)
        with torch.inference_mode(), autocast():
            parts = [
                encode(self.network, torch.from_numpy(images[i : i + _BATCH])).float()
                for i in range(0, len(images), _BATCH)
            ]
        return nn.functional.normalize(torch.cat(parts)).numpy()


class CosineScorer(VectorScorer):
    """Cosine of the vectors, negative ones taken as 0, of touches and stored contacts."""

    def score(self, index, mask: SoftMask) -> NDArray[np.float32]:  # type: ignore[no-untyped-def]
        """Similarity (P, n) of ``mask`` (h, w) to the mask of every pose, 0 to 1."""
        return np.maximum(self.stored @ self.seen(index, mask), 0).reshape(index.height.shape)


class _Bottleneck(nn.Module):
    """1 x 1, 3 x 3 and 1 x 1 convolutions beside a shortcut; the stride lies in the middle one."""

    def __init__(self, inside: int, width: int, stride: int, last: bool):
        super().__init__()
        outside = 4 * width
        self.path = nn.Sequential(
            *_conv(inside, width, 1),
            nn.ReLU(inplace=True),
            *_conv(width, width, 3, stride),
            nn.ReLU(inplace=True),
            *_conv(width, outside, 1),
        )
        same = stride == 1 and inside == outside
        self.shortcut = nn.Identity() if same else nn.Sequential(*_conv(inside, outside, 1, stride))
        self.end = nn.Identity() if last else nn.ReLU(inplace=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = self.end(self.path(x) + self.shortcut(x))
        return out


def _conv(inside: int, outside: int, size: int, stride: int = 1) -> tuple[nn.Module, nn.Module]:
    return nn.Conv2d(inside, outside, size, stride, size // 2, bias=False), nn.BatchNorm2d(outside)


def make_network() -> nn.Module:
    """ResNet-50 (He et al. 2016) whose last activation is the identity, for images (n, 3, s, s)."""
    layers: list[nn.Module] = [*_conv(3, 64, 7, 2), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2, 1)]
    inside = 64
    for stage, blocks in enumerate(_BLOCKS):
        for block in range(blocks):
            stride = 2 if stage > 0 and block == 0 else 1
            last = stage == len(_BLOCKS) - 1 and block == blocks - 1
            layers.append(_Bottleneck(inside, 64 << stage, stride, last))
            inside = 256 << stage
    network = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(inside, NUMBERS))
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
    return network


def resized(masks: NDArray[np.bool_], side: int) -> NDArray[np.float32]:
    """Images (n, side, side) of masks (n, h, w), as the network is given them."""
    return np.stack([cv2.resize(m.astype(np.float32), (side, side), interpolation=cv2.INTER_LINEAR) for m in masks])


def encode(network: nn.Module, images: torch.Tensor) -> torch.Tensor:
    """Vectors (n, 1000) of images (n, s, s)."""
    out: torch.Tensor = network(images[:, None].expand(-1, 3, -1, -1))
    return out


def load_resnet(path: Path) -> Resnet:
    """A trained network from a safetensors file.

    Raises
    ------
    InputError
        The file holds the weights of another architecture.
    """
    from safetensors import safe_open
    from safetensors.torch import load_file

    with safe_open(str(path), framework="pt") as file:
        side = int((file.metadata() or {}).get("side", SIDE))
    network = make_network()
    try:
        network.load_state_dict({name: value.float() for name, value in load_file(path).items()})
    except RuntimeError as error:
        raise InputError(
            f"{path}: the weights of another network ({str(error).splitlines()[0]}); give a file that "
            "'geomtact train --architecture resnet50' wrote"
        ) from None
    return Resnet(network.eval(), side, hashlib.sha256(path.read_bytes()).hexdigest()[:16])
