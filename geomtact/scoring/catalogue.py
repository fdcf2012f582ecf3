"""Every score by its name."""

from __future__ import annotations

import hashlib
from pathlib import Path

from geomtact.contact_space.index import Index
from geomtact.errors import InputError, UsageError, nearest_name
from geomtact.scoring.descriptors import CLASSICAL
from geomtact.scoring.encoder import THESIS, WEIGHTS, EncoderScorer, Tower, about, cell_size, load_weights
from geomtact.scoring.likelihood import PixelLikelihood
from geomtact.scoring.overlap import OVERLAPS
from geomtact.scoring.protocol import Scorer
from geomtact.scoring.vectors import Descriptor, VectorScorer

PIXELWISE: dict[str, Scorer] = {**OVERLAPS, "likelihood": PixelLikelihood()}
DEFAULT_SCORER = "encoder"
SCORERS = (*PIXELWISE, *CLASSICAL, "moments", DEFAULT_SCORER)
_WEIGHTS_FILE = ".safetensors"


def check_name(name: str) -> None:
    """Refuse what names no score.

    Raises
    ------
    UsageError
        ``name`` is neither one of ``SCORERS`` nor a weights file (.safetensors).
    """
    if name not in SCORERS and not name.endswith(_WEIGHTS_FILE):
        raise UsageError(f"no score named {name!r}{nearest_name(name, SCORERS)}")


def descriptor_of(name: str, index: Index) -> tuple[Descriptor, type[VectorScorer]] | None:
    """What makes the vectors of the score ``name`` on ``index``, and what compares them; None if it compares none.

    Raises
    ------
    InputError
        The weights file cannot be read, or holds those of another network, or for another object or sensor.
    """
    if name in CLASSICAL:
        return CLASSICAL[name], VectorScorer
    if not name.endswith(_WEIGHTS_FILE) and name != DEFAULT_SCORER:
        return None
    path = Path(name) if name.endswith(_WEIGHTS_FILE) else WEIGHTS
    metadata = about(path)
    _check_whose(path, metadata, index)
    if metadata.get("architecture") == THESIS:
        from geomtact.scoring.resnet import CosineScorer, load_resnet  # it needs torch, a touch by the encoder does not

        return load_resnet(path), CosineScorer
    swing = index.angle_step * index.mesh.radius_rms
    return Tower(load_weights(path), cell_size(index.sensor, index.resolution.step, swing)), EncoderScorer


def vectors_file(folder: Path, descriptor: Descriptor) -> Path:
    """Where the vectors that a descriptor makes of an index lie, whose cache entry is ``folder``."""
    return folder / f"{descriptor.name}-{fingerprint(descriptor)}.npy"


def _check_whose(path: Path, metadata: dict[str, str], index: Index) -> None:
    for what, given in (("part", index.mesh), ("sensor", index.sensor)):
        if metadata.get(f"{what}_sha256", given.sha256) != given.sha256:
            raise InputError(
                f"{path}: trained for the {what} {metadata[what]!r}, not for {given.name!r}; train weights for it, or use the "
                f"score {DEFAULT_SCORER!r}, which serves all"
            )


def fingerprint(descriptor: Descriptor) -> str:
    """Of what a descriptor's vectors depend on: its settings, or its weights."""
    return hashlib.sha256(repr(descriptor).encode()).hexdigest()[:12]
