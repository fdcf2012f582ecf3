"""The number format in which this processor multiplies matrices fastest."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager
from functools import cache

import torch

_SHAPE = (128, 768, 512)  # one product of the network, for few contacts
_TURNS = 3
_FASTER = 0.8  # share of the time in float32 below which bfloat16 must stay; emulated, it takes many times as long


@cache
def fastest_precision() -> torch.dtype:
    """``torch.bfloat16`` where the processor computes in it, ``torch.float32`` where torch would only emulate it.

    It is measured, once a process: torch does not report bfloat16 alike for all processors and all limits set by the
    environment (``ATEN_CPU_CAPABILITY``, ``ONEDNN_MAX_CPU_ISA``).
    """
    took = {dtype: float("inf") for dtype in (torch.float32, torch.bfloat16)}
    operands = {dtype: (torch.ones(_SHAPE[:2], dtype=dtype), torch.ones(_SHAPE[1:], dtype=dtype)) for dtype in took}
    for turn in range(_TURNS + 1):
        for dtype, (a, b) in operands.items():
            began = time.perf_counter()
            a @ b
            if turn:  # the first product also sets the kernel up
                took[dtype] = min(took[dtype], time.perf_counter() - began)
    return torch.bfloat16 if took[torch.bfloat16] < _FASTER * took[torch.float32] else torch.float32


def autocast(device: str = "cpu") -> AbstractContextManager:
    """Within it, torch multiplies in bfloat16 where ``device`` computes in it, else in float32."""
    return torch.autocast(device, torch.bfloat16, enabled=device != "cpu" or fastest_precision() == torch.bfloat16)
