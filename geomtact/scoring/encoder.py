"""The similarity network: one small encoder for all objects, so that a new object needs no training.

Two towers that share most of their weights: one for what the sensor shows, one for what was simulated on the grid. It was
trained so that minus the squared distance of the vectors is a log likelihood up to a constant: the cell that holds the
touch is to get the largest posterior among all cells of its object (``training.train``). The architecture is a plain
perceptron over the pixels and the contact's moments: a million contacts take seconds, and a touch needs no torch.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from geomtact.contact_space.index import Index
from geomtact.errors import InputError
from geomtact.scoring.contact_features import BASIS, SHAPE, moment_features
from geomtact.scoring.vectors import VectorScorer
from geomtact.sensing.contact import SoftMask
from geomtact.sensing.moments import cleaned
from geomtact.sensing.sensor import Sensor

WEIGHTS = Path(__file__).with_name("encoder.safetensors")  # trained once for all objects, with a card beside it
ARCHITECTURE, THESIS = "encoder", "resnet50"  # as the metadata of weights name them
Weights = dict[str, NDArray[np.float32]]


@dataclass(frozen=True, eq=False)
class EncoderScorer(VectorScorer):
    """Minus the squared distance between the network's vectors of the observed and of every stored contact.

    16 numbers: 64 bytes per pose, 16 multiplications to compare, 8 microseconds to describe on two cores.

    Attributes
    ----------
    usual : largest squared distance to the nearest stored contact that is usual for touches of the object. A contact
        farther from all of them is out of distribution for the network, and its scores count for less in proportion.
    """

    usual: float = np.inf

    def score(self, index: Index, mask: SoftMask) -> NDArray[np.float32]:
        """Similarity (P, n) of ``mask`` (h, w) to the mask of every pose: minus the squared distance of the vectors, as
        far as it is to be trusted."""
        out = super().score(index, mask)
        out *= self.trust(float(out.max()))
        return out

    def trust(self, best: float) -> np.float32:
        """What scores are to be multiplied by, of which the ``best`` is given."""
        return np.float32(min(1.0, self.usual / max(-best, 1e-9)))

    def seen(self, index: Index, mask: SoftMask) -> NDArray[np.float32]:
        """Vector (d,) of the observed ``mask`` (h, w)."""
        assert isinstance(self.descriptor, Tower)
        image = _lying(cleaned(mask, index.sensor)[None].astype(np.float32))[0]
        small = cv2.resize(image, SHAPE[::-1], interpolation=cv2.INTER_AREA)
        return vector(self.descriptor.weights, small, self.descriptor.cell)


@dataclass(frozen=True, eq=False)
class Tower:
    """The network's side for stored contacts, as a descriptor."""

    weights: Weights
    cell: NDArray[np.float32]  # see ``cell_size``
    name: str = "encoder"

    def __repr__(self) -> str:
        digest = hashlib.sha256(b"".join(name.encode() + w.tobytes() for name, w in sorted(self.weights.items())))
        return f"Tower({digest.hexdigest()})"

    def describe(self, masks: NDArray[np.bool_], sensor: Sensor) -> NDArray[np.float32]:
        """Vectors (m, d) of masks (m, h, w), which are as fine as ``SHAPE`` or a whole number of times finer."""
        from geomtact.scoring.network import run

        images = _lying(masks.astype(np.float32))
        n, h, w = images.shape
        blocks = images.reshape(n, SHAPE[0], h // SHAPE[0], SHAPE[1], w // SHAPE[1])
        return run(self.weights, blocks.mean((2, 4), dtype=np.float32), self.cell, "stored")


def cell_size(sensor: Sensor, step: float, swing: float) -> NDArray[np.float32]:
    """What the network gets of a grid (2,): log of the lattice step and of the ``swing`` [m] by which the next
    rotation moves the object's surface, in units of the window's half diagonal."""
    return np.log(np.maximum([step, swing], 1e-6) / np.hypot(*sensor.half_window)).astype(np.float32)


def vector(
    weights: Weights, image: NDArray[np.float32], cell: NDArray[np.float32], head: str = "touch"
) -> NDArray[np.float32]:
    """What ``network.Encoder`` makes of one touch: vector (d,) of an image (24, 32), the share of each pixel in contact."""
    m = np.concatenate([moment_features(image.reshape(1, -1) @ BASIS, np)[0], cell])
    x = np.concatenate([image.ravel(), m])
    for layer in ("trunk.0", "trunk.2"):
        x = _gelu(weights[f"{layer}.weight"] @ x + weights[f"{layer}.bias"])
    x = _gelu(weights[f"heads.{head}.0.weight"] @ np.concatenate([x, m]) + weights[f"heads.{head}.0.bias"])
    return np.asarray(weights[f"heads.{head}.2.weight"] @ x + weights[f"heads.{head}.2.bias"], np.float32)


def about(path: Path) -> dict[str, str]:
    """What a weights file states: ``architecture``, and ``part`` and ``sensor`` where it is for one object alone; nothing
    of a file that cannot be read."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="np") as file:
            return dict(file.metadata() or {})
    except (OSError, SafetensorError):
        return {}


def load_weights(path: Path) -> Weights:
    """The encoder's weights from a safetensors file.

    Raises
    ------
    InputError
        The file cannot be read, or holds the weights of another architecture.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    advice = "give a file that 'geomtact train' wrote"
    try:
        weights = {name: np.asarray(value, np.float32) for name, value in load_file(str(path)).items()}
        for head in ("touch", "stored"):
            vector(weights, np.zeros(SHAPE, np.float32), np.zeros(2, np.float32), head)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {advice}") from None
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: not a whole safetensors file ({error}); {advice}") from None
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: the weights of another network ({error}); {advice}") from None
    return weights


def _lying(masks: NDArray[np.float32]) -> NDArray[np.float32]:
    """Masks (n, h, w) of a tall window mirrored about its diagonal, so that they lie; others as they are."""
    return np.ascontiguousarray(np.swapaxes(masks, 1, 2)) if masks.shape[1] > masks.shape[2] else masks


def _gelu(x: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(0.5 * x * (1 + erf(x / np.sqrt(2))), np.float32)
