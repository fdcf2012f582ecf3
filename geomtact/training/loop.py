"""What the trainings of the encoder and of the mask network share from step to step.

Seeds, the learning rate, and a loss that has to stay a number.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.optim import Optimizer

from geomtact.errors import GeomtactError
from geomtact.training.state import not_a_number


def steps(
    optimizer: Optimizer, first: int, n: int, rate: float, seed: int
) -> Iterator[tuple[int, np.random.Generator]]:
    """The steps from ``first`` on, of ``n`` in all, gradients at zero and the ``rate`` as it is there. Each has a seed of its
    own, so that a resumed run draws what an uninterrupted one does."""
    for step in range(first, n):
        for group in optimizer.param_groups:
            group["lr"] = rate * schedule(step, n)
        optimizer.zero_grad()
        yield step, np.random.default_rng([seed, step])


def schedule(step: int, n: int) -> float:
    """Share of the learning rate at a step of ``n``: a short rise, then half a cosine."""
    return min(1.0, (step + 1) / 100) * (0.5 + 0.5 * math.cos(math.pi * step / n))


def descend(network: nn.Module, optimizer: Optimizer, loss: float, folder: Path, step: int) -> None:
    """Go down the gradients that ``network`` holds, cut to a norm of 1.

    Raises
    ------
    GeomtactError
        The ``loss`` or a gradient is not a number; the last good state stays in ``folder``.
    """
    norm = float(torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0))
    if not (math.isfinite(norm) and math.isfinite(loss)):
        raise GeomtactError(not_a_number(folder, step))
    optimizer.step()
