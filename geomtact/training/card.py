"""What a trained encoder is and where it came from: weights, a model card and a picture of how it learned."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safetensors.torch import save_file
from torch import nn

from geomtact.files import write_text, write_whole
from geomtact.scoring.encoder import ARCHITECTURE
from geomtact.scoring.network import Encoder
from geomtact.training.augment import AUGMENTATIONS
from geomtact.training.scenes import TrainingScene
from geomtact.training.train import Curve, Settings
from geomtact.versions import versions

SCHEMA = "geomtact/encoder/1"


def write_encoder(
    path: Path,
    network: Encoder,
    curve: Curve,
    settings: Settings,
    scenes: Sequence[TrainingScene],
    data: dict[str, Any],
) -> None:
    """Write ``path`` (safetensors, half precision), and beside it the card (.json) and the curves (.png).

    ``data`` states where the scenes come from; weights for one ``part`` on one ``sensor`` state so in their metadata too.
    """
    keys = ("part", "part_sha256", "sensor", "sensor_sha256")
    meta = {"architecture": ARCHITECTURE} | {key: str(data[key]) for key in keys if key in data}
    card = {
        "data": data
        | {
            "scenes": len(scenes),
            "touches": sum(len(s.true) for s in scenes),
            "stored contacts": sum(len(s.weight) for s in scenes),
        },
        "settings": asdict(settings),
        "augmentations": [{"name": a.name, "range": a.range, "reason": a.reason} for a in AUGMENTATIONS],
        "curve": asdict(curve),
    }
    write_network(path, network, SCHEMA, card, meta)
    draw_curve(curve, path.with_suffix(".png"))


def write_network(
    path: Path, network: nn.Module, schema: str, card: dict[str, Any], meta: dict[str, str] | None = None
) -> None:
    """Write the weights to ``path``, half precision, with ``meta`` in them; and beside it ``card``, with what all cards say."""
    path.parent.mkdir(parents=True, exist_ok=True)
    weights = {name: value.half().contiguous() for name, value in network.state_dict().items()}
    write_whole(path, lambda temporary: save_file(weights, temporary, meta))
    own = {
        "schema": schema,
        "parameters": sum(p.numel() for p in network.parameters()),
        "bytes": path.stat().st_size,
    }
    text = json.dumps(own | card | {"versions": versions("kornia", "manifold3d")}, indent=1)
    write_text(path.with_suffix(".json"), text + "\n")


def draw_curve(curve: Curve, path: Path) -> None:
    """A picture of the gain over the steps."""
    from matplotlib.figure import Figure

    figure = Figure((6, 3.5), layout="constrained")
    axes = figure.add_subplot(
        xlabel="step", ylabel="gain [nats]", title="Information gained about the cell that holds a touch"
    )
    axes.plot(curve.step, curve.training, color="#E69F00", label="touches that it learns from")
    axes.plot(curve.step, curve.validation, color="#0072B2", label="scenes that it never saw")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    write_whole(path, lambda temporary: figure.savefig(temporary, dpi=120))
