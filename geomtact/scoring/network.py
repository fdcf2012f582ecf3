"""The similarity network in torch: for training, and for describing a million stored contacts at a time."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from geomtact.scoring.contact_features import BASIS, BESIDE, SHAPE, moment_features
from geomtact.scoring.precision import autocast

_BATCH = 8192


class Encoder(nn.Module):
    """Vectors of contacts."""

    basis: torch.Tensor

    def __init__(self, width: int = 512, dimension: int = 16):
        super().__init__()
        n = SHAPE[0] * SHAPE[1] + BESIDE
        self.trunk = nn.Sequential(nn.Linear(n, width), nn.GELU(), nn.Linear(width, width), nn.GELU())
        self.heads = nn.ModuleDict(
            {
                side: nn.Sequential(nn.Linear(width + BESIDE, width // 2), nn.GELU(), nn.Linear(width // 2, dimension))
                for side in ("touch", "stored")
            }
        )

        self.register_buffer("basis", torch.from_numpy(BASIS), persistent=False)

    def forward(self, images: torch.Tensor, cell: torch.Tensor, side: str) -> torch.Tensor:
        """Vectors (n, d) of images (n, 24, 32), the share of each pixel in contact, on a grid of ``cell`` (2,).

        ``side`` is "touch" or "stored".
        """
        with torch.autocast("cpu", enabled=False):  # differences of squares need single precision
            sums = images.float().flatten(1) @ self.basis  # (n, 6)
        m = torch.cat([moment_features(sums, torch), cell.expand(len(images), 2)], 1)  # (n, 8)
        x = self.trunk(torch.cat([images.flatten(1), m], 1))  # (n, width)
        with torch.autocast(
            "cpu", enabled=False
        ):  # in bfloat16 it would make half of the error and save hardly any time
            out: torch.Tensor = self.heads[side](torch.cat([x.float(), m], 1))
        return out


def run(
    weights: dict[str, NDArray[np.float32]], images: NDArray[np.float32], cell: NDArray[np.float32], side: str
) -> NDArray[np.float32]:
    """Vectors (n, d) of ``images`` (n, 24, 32) on a grid of ``cell`` (2,), in the precision that is fastest here."""
    network, grid = with_weights(weights), torch.from_numpy(cell)
    with torch.inference_mode(), autocast():
        batches = (torch.from_numpy(images[i : i + _BATCH]) for i in range(0, len(images), _BATCH))
        parts = [network(batch, grid, side) for batch in batches]
    return np.asarray(torch.cat(parts).numpy())


def with_weights(weights: dict[str, NDArray[np.float32]]) -> Encoder:
    """The network with given weights; raises RuntimeError or KeyError for the weights of another."""
    network = Encoder(len(weights["trunk.0.bias"]), len(weights["heads.touch.2.bias"]))
    network.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    return network.eval()
