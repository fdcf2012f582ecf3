"""Broken files of every kind: each is read, or refused in one line; nothing else is raised, and nothing hangs.

``GEOMTACT_FUZZ=10`` reads ten times as many.
"""

import io
import json
import os
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from geomtact import GeomtactError, Sensor, load_mesh
from geomtact.cli.next_touch import read_actions
from geomtact.cli.sensor_poses import read_sensor_poses
from geomtact.inference import files
from geomtact.inference.effort import GRID_ALONE
from geomtact.report.exchange import from_bop, from_tum
from geomtact.scoring.encoder import load_weights
from geomtact.sensing.image_file import ImageFile, read_image

TIMES = int(os.environ.get("GEOMTACT_FUZZ", "1"))


def picture(form, **options):
    out = io.BytesIO()
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 255, (12, 16, 3), np.uint8)).save(out, form, **options)
    return out.getvalue()


def array():
    out = io.BytesIO()
    np.save(out, np.linspace(0, 1e-3, 48).reshape(6, 8))
    return out.getvalue()


def mesh(form):
    found = trimesh.creation.box((0.01, 0.02, 0.03)).export(file_type=form)
    return found.encode() if isinstance(found, str) else found


POSES = json.dumps(
    {
        "T_world_sensor": [np.diag([1.0, z, z, 1.0]).tolist() for z in (1, -1)],
        "sensor": ["digit", "gelslim"],
        "std_mm": 0.1,
    }
).encode()
ACTIONS = json.dumps(
    {
        "actions": [{"T_world_sensor": np.eye(4).tolist(), "travel": 0.1, "cost": 2}]
        + [{"probe": {"point": [0, 0, 0.1], "direction": [0, 0, -1]}}]
    }
).encode()
GS_SDK = b"gs_sdk:\n  ppmm: 0.0634\n  imgw: 320\n  imgh: 240\nppmm: 0.0634\nimgw: 320\nimgh: 240\n"
HEADER = {"a": {"dtype": "F32", "shape": [2, 2], "data_offsets": [0, 16]}, "__metadata__": {"schema": "x"}}
TENSORS = struct.pack("<Q", len(json.dumps(HEADER))) + json.dumps(HEADER).encode() + bytes(16)
BOP = b"scene_id,im_id,obj_id,score,R,t,time\n1,2,3,0.5,1 0 0 0 1 0 0 0 1,10 20 30,-1\n"
KINDS = {
    "png": (lambda: picture("PNG"), read_image, 1200),
    "jpg": (lambda: picture("JPEG"), read_image, 800),
    "bmp": (lambda: picture("BMP"), read_image, 500),
    "tiff": (lambda: picture("TIFF"), read_image, 800),
    "npy": (array, read_image, 800),
    "meta.png": (lambda: picture("PNG"), lambda path: ImageFile.read(path).metadata, 300),
    "stl": (lambda: mesh("stl"), lambda path: load_mesh(path, "m"), 1000),
    "ascii.stl": (lambda: mesh("stl_ascii"), lambda path: load_mesh(path, "m"), 500),
    "obj": (lambda: mesh("obj"), lambda path: load_mesh(path, "m"), 700),
    "ply": (lambda: mesh("ply"), lambda path: load_mesh(path, "m"), 700),
    "glb": (lambda: mesh("glb"), load_mesh, 700),
    "toml": (lambda: Sensor.load("digit").to_toml().encode(), Sensor.load, 1000),
    "yaml": (lambda: GS_SDK, Sensor.load, 500),
    "poses.json": (lambda: POSES, lambda path: read_sensor_poses(path, 2), 700),
    "actions.json": (lambda: ACTIONS, read_actions, 700),
    "safetensors": (lambda: TENSORS, load_weights, 400),
    "csv": (lambda: BOP, from_bop, 400),
    "txt": (lambda: b"0.5 1 2 3 0 0 0 1\n# more\n1.5 1 2 3 0 0 1 0\n", from_tum, 400),
}


def mutated(data, rng):
    """A few bytes changed, put in, taken out or doubled, or the end cut off."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(len(out))) if out else 0
        kind = rng.integers(6)
        if kind == 0 and out:
            out[at] ^= 1 << int(rng.integers(8))
        elif kind == 1 and out:
            out[at] = int(rng.choice([0, 1, 0x7F, 0x80, 0xFF, ord("-"), ord("9"), ord("["), ord('"')]))
        elif kind == 2:
            out[at:at] = rng.bytes(int(rng.integers(1, 9)))
        elif kind == 3:
            del out[at : at + int(rng.integers(1, 9))]
        elif kind == 4:
            out[at:at] = out[at : at + int(rng.integers(1, 33))]
        else:
            del out[at:]
    return bytes(out)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", KINDS)
def test_a_broken_file_is_read_or_refused_in_one_line(kind, tmp_path):
    made, read, n = KINDS[kind]
    rng, data = np.random.default_rng(sum(kind.encode())), made()
    path = tmp_path / f"file.{kind}"
    path.write_bytes(data)
    if kind != "safetensors":
        read(path)
    for number in range(n * TIMES):
        broken = mutated(data, rng)
        path.write_bytes(broken)
        try:
            read(path)
        except GeomtactError as error:
            assert str(error) and "\n" not in str(error).strip(), broken
        except Exception as error:
            raise AssertionError(f"{kind} {number}: {type(error).__name__}: {error}: {broken[:300]!r}") from error


@pytest.mark.parametrize("kind", ["toml", "yaml", "poses.json", "actions.json", "csv", "txt"])
def test_text_saved_otherwise_than_as_utf_8_is_refused_as_that(kind, tmp_path):
    """As some editors save it; for JSON whose message is shorter, by what was expected."""
    made, read, _ = KINDS[kind]
    path = tmp_path / f"file.{kind}"
    path.write_bytes(made().decode().encode("utf-16"))
    with pytest.raises(GeomtactError) as refused:
        read(path)
    assert "not saved as UTF-8" in str(refused.value) or kind == "actions.json"
    path.write_bytes(b"\xef\xbb\xbf" + made())
    read(path)


@pytest.mark.parametrize("kind", ["poses.json", "actions.json"])
def test_lists_within_lists_are_refused_however_deep(kind, tmp_path):
    path = tmp_path / f"file.{kind}"
    path.write_bytes(b"[" * 100_000 + b"]" * 100_000)
    with pytest.raises(GeomtactError):
        KINDS[kind][1](path)


def test_a_broken_posterior_is_refused_in_one_line(ball, a_touch, tmp_path, monkeypatch):
    """Where its poses would have to be simulated anew, that is not done here."""
    path = tmp_path / "posterior.npz"
    ball.localize(a_touch(ball)[1], effort=GRID_ALONE).save(path)
    whole, rng = path.read_bytes(), np.random.default_rng(7)
    monkeypatch.setattr(files, "open_index", lambda *args, **options: ball.index)
    for number in range(150 * TIMES):
        path.write_bytes(mutated(whole, rng))
        try:
            files.load(path)
        except GeomtactError as error:
            assert str(error) and "\n" not in str(error).strip()
        except Exception as error:
            raise AssertionError(f"{number}: {type(error).__name__}: {error}") from error
