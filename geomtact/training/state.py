"""The state of a training that goes on after a kill, whose it is, and what all trainings share from step to step."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import nn
from torch.optim import Optimizer

from geomtact.errors import GeomtactError, InputError
from geomtact.files import write_text, write_whole
from geomtact.geometry.mesh import Mesh
from geomtact.sensing.sensor import Sensor

Curve = dict[str, list[float]]
_FILE, _RECIPE = "state.safetensors", "recipe.json"
_ANOTHER = "--start: the weights of another network; give a file that 'geomtact train' wrote"
_FREE = ("rate",)  # a setting that a resumed run may change


def whose(mesh: Mesh, sensor: Sensor) -> dict[str, str]:
    """What weights for one object on one sensor say of themselves."""
    return {
        "part": mesh.name,
        "part_sha256": mesh.sha256,
        "sensor": sensor.name,
        "sensor_sha256": sensor.sha256,
    }


def claim(folder: Path, recipe: Mapping[str, Any]) -> None:
    """Keep ``folder`` for the training that ``recipe`` describes, so that it never reads another's.

    Raises
    ------
    InputError
        It holds another training.
    """
    path, expected = folder / _RECIPE, json.loads(json.dumps(recipe))
    if path.exists():
        held = json.loads(path.read_text("utf-8"))
        if held != expected:
            other = ", ".join(key for key in expected if held.get(key) != expected[key]) or "what it learns from"
            raise InputError(
                f"{folder}: holds another training ({other} differs); give another folder with --work, or remove this one"
            )
        return
    folder.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(expected, indent=1) + "\n")


def read_weights(path: Path) -> dict[str, torch.Tensor]:
    """The weights in a safetensors file, in single precision, to go on training from."""
    try:
        return {name: value.float() for name, value in load_file(path).items()}
    except (OSError, SafetensorError) as error:
        raise InputError(
            f"--start {path}: not a whole safetensors file ({error}); give one that 'geomtact train' wrote"
        ) from None


def sha256_of(start: Path | None) -> str | None:
    """SHA-256 of the weights to start from, None for none."""
    if start is None:
        return None
    try:
        return hashlib.sha256(start.read_bytes()).hexdigest()
    except OSError:
        raise InputError(f"--start {start}: no such file; give a file that 'geomtact train' wrote") from None


def begin_with(network: nn.Module, weights: Mapping[str, torch.Tensor]) -> None:
    """Give ``network`` the ``weights`` to start from; those of another one are refused."""
    try:
        network.load_state_dict(weights)
    except RuntimeError:
        raise InputError(_ANOTHER) from None


def size_of(weights: Mapping[str, torch.Tensor]) -> dict[str, int]:
    """``width`` and ``dimension`` of an encoder's weights."""
    try:
        return {"width": len(weights["trunk.0.bias"]), "dimension": len(weights["heads.touch.2.bias"])}
    except KeyError:
        raise InputError(_ANOTHER) from None


def save_state(
    folder: Path, network: nn.Module, optimizer: Optimizer, settings: Mapping[str, Any], step: int, curve: Curve
) -> None:
    """All that :func:`resume` needs, in one file that is whole or absent."""
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {f"network.{k}": v.contiguous() for k, v in network.state_dict().items()}
    for i, state in optimizer.state_dict()["state"].items():
        tensors |= {
            f"optimizer.{i}.{k}": v.clone(memory_format=torch.contiguous_format)
            for k, v in state.items()
            if v is not None
        }
    meta = {"step": str(step), "settings": json.dumps(settings), "curve": json.dumps(curve)}
    write_whole(folder / _FILE, lambda temporary: save_file(tensors, temporary, meta))


def resume(
    folder: Path, network: nn.Module, optimizer: Optimizer, settings: Mapping[str, Any]
) -> tuple[int, Curve | None]:
    """Bring back what :func:`save_state` wrote under the same settings: the step to go on with, 0 for none, and the curve.

    Another learning rate is no hindrance: it is what a run that failed may have to change.
    """
    meta = _meta(folder / _FILE)
    if meta is None or _fixed(json.loads(meta["settings"])) != _fixed(settings):
        return 0, None
    tensors = load_file(folder / _FILE)
    network.load_state_dict({k.removeprefix("network."): v for k, v in tensors.items() if k.startswith("network.")})
    states: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimizer."):
            _, i, k = name.split(".")
            states.setdefault(int(i), {})[k] = value
    optimizer.load_state_dict({"state": states, "param_groups": optimizer.state_dict()["param_groups"]})
    return int(meta["step"]), json.loads(meta["curve"])


def not_a_number(folder: Path, step: int) -> str:
    """The message of a training whose loss is not a number at ``step``."""
    meta = _meta(folder / _FILE)
    kept = f"the state of step {meta['step']} is kept in {folder}" if meta else "no state is kept yet"
    return f"training: the loss is not a number at step {step}; {kept}; go on with a smaller --rate"


def _fixed(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if key not in _FREE}


def _meta(path: Path) -> dict[str, str] | None:
    try:
        with safe_open(str(path), framework="pt") as file:
            return dict(file.metadata())
    except (OSError, SafetensorError):
        return None


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
