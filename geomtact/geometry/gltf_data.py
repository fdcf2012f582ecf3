"""The numbers of a glTF 2.0 file: its JSON, its buffers, and the accessors that say how to read them."""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from geomtact.errors import MeshError
from geomtact.json_values import read_json
from geomtact.se3 import Array

_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_JSON_CHUNK, _BINARY_CHUNK = b"JSON", b"BIN\0"


class GltfData:
    """What a .gltf or .glb file holds, by name and number. Errors do not name the file.

    Attributes
    ----------
    content : the JSON part
    """

    def __init__(self, path: Path) -> None:
        self._folder = path.parent
        with open(path, "rb") as file:
            binary = file.read(4) == b"glTF"
        chunks = _chunks(path.read_bytes()) if binary else {}
        self.content: dict[str, Any] = json.loads(chunks[_JSON_CHUNK]) if binary else read_json(path)
        self._binary = chunks.get(_BINARY_CHUNK)
        self._buffers: dict[int, bytes] = {}

    def at(self, name: str, index: int) -> dict[str, Any]:
        """The ``index``-th of the meshes, nodes, accessors, ..."""
        entries = self.content.get(name, [])
        if not 0 <= index < len(entries):
            raise MeshError(f"it names number {index} of {len(entries)} {name}; export it again")
        return entries[index]

    def numbers(self, index: int, kind: str, owner: Mapping[str, Any], *, or_zeros: bool = False) -> Array:
        """The ``index``-th accessor (count, width), normalised integers as the numbers that they mean.

        Parameters
        ----------
        kind : "SCALAR", "VEC3" or "VEC4", which it has to be
        owner : what names the accessor, whose extensions are blamed if it has no data
        or_zeros : whether it is zero where neither it nor an extension has data, as glTF 2.0 says
        """
        accessor = self.at("accessors", index)
        count, width = accessor["count"], _WIDTHS[kind]
        if accessor["type"] != kind:
            raise MeshError(f"accessor {index}: expected {kind}, got {accessor['type']}; export it again")
        dtype = _dtype(accessor["componentType"])
        if "bufferView" in accessor:
            raw = self._view(accessor, count, width, dtype, (owner, accessor))
        elif "sparse" in accessor or (or_zeros and not accessor.get("extensions")):
            raw = np.zeros((count, width), dtype)
        else:
            raise _no_data(owner, accessor)
        if "sparse" in accessor:
            raw = raw.copy()
            sparse = accessor["sparse"]
            where, n = sparse["indices"], sparse["count"]
            rows = self._view(where, n, 1, _dtype(where["componentType"]), (owner, accessor))[:, 0]
            raw[rows] = self._view(sparse["values"], n, width, dtype, (owner, accessor))
        values = raw.astype(float)
        return np.maximum(values / np.iinfo(dtype).max, -1) if accessor.get("normalized") else values

    def _view(
        self, at: Mapping[str, Any], count: int, width: int, dtype: np.dtype, owners: tuple[Mapping[str, Any], ...]
    ) -> NDArray[Any]:
        """``count`` rows of ``width`` numbers from the buffer view that ``at`` names."""
        view = self.at("bufferViews", at["bufferView"])
        data = self._buffer(view["buffer"], (*owners, view))
        offset, row = at.get("byteOffset", 0), width * dtype.itemsize
        step = view.get("byteStride") or row
        start, length = view.get("byteOffset", 0), view["byteLength"]
        if min(offset, start, count, step - row) < 0 or start + length > len(data):
            raise MeshError("a view reaches beyond its buffer; export it again")
        if count and offset + (count - 1) * step + row > length:
            raise MeshError("an accessor reaches beyond its view of a buffer; export it again")
        return np.ndarray((count, width), dtype, data, start + offset, (step, dtype.itemsize))

    def _buffer(self, index: int, owners: tuple[Mapping[str, Any], ...]) -> bytes:
        if index not in self._buffers:
            buffer = self.at("buffers", index)
            if "uri" in buffer:
                data = self._read_uri(buffer["uri"])
            elif index == 0 and self._binary is not None and not buffer.get("extensions"):
                data = self._binary
            else:
                raise _no_data(*owners, buffer)
            if len(data) < buffer["byteLength"]:
                raise MeshError(
                    f"its buffer {index} is cut short: expected {buffer['byteLength']:,} bytes, found {len(data):,}; "
                    "copy or export it again"
                )
            self._buffers[index] = data
        return self._buffers[index]

    def _read_uri(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            data = unquote_to_bytes(body)
            return base64.b64decode(data) if head.endswith(";base64") else data
        if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:", uri):
            raise MeshError(f"its buffer lies at {uri[:80]}; save the buffer beside the file, or export it as .glb")
        # programs write file names percent-encoded, as they should, or as they are, or with Windows' separators
        names = [os.fsdecode(unquote_to_bytes(uri)), uri, uri.replace("\\", "/")]
        found = next((self._folder / name for name in names if (self._folder / name).is_file()), None)
        if found is None:
            raise MeshError(f"its buffer {names[0]!r} is not there; copy it beside the file, or export it as .glb")
        return found.read_bytes()


def _chunks(data: bytes) -> dict[bytes, bytes]:
    """The chunks of a .glb file by their type, the first of each."""
    version, length = (int.from_bytes(data[k : k + 4], "little") for k in (4, 8))
    if version != 2:
        raise MeshError(f"expected glTF 2.0, got version {version}; export it as glTF 2.0")
    if length > len(data):
        raise MeshError(f"is cut short: expected {length:,} bytes, found {len(data):,}; copy or export it again")
    chunks: dict[bytes, bytes] = {}
    at = 12
    while at + 8 <= length:
        end = at + 8 + int.from_bytes(data[at : at + 4], "little")
        if end > length:
            raise MeshError("is cut short: a chunk reaches beyond its end; copy or export it again")
        chunks.setdefault(data[at + 4 : at + 8], data[at + 8 : end])
        at = end
    return chunks


def _dtype(component: int) -> np.dtype:
    if component not in _TYPES:
        raise MeshError(f"its numbers are of component type {component}, which is not read; export it as glTF 2.0")
    return np.dtype(_TYPES[component])


def _no_data(*owners: Mapping[str, Any]) -> MeshError:
    """Whose numbers are not where glTF itself has them, by the names of the extensions that have them."""
    names = sorted({name for owner in owners for name in owner.get("extensions", {})})
    if names:
        return MeshError(
            f"its mesh lies in the glTF extension {', '.join(names)}, which is not read; export without it"
        )
    return MeshError("its mesh has no data; export it again")
