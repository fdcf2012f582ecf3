"""Standard error holds geomtact's lines alone, and no file name is too unusual: success prints no library's messages."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from geomtact.geometry.mesh_file import load_mesh
from geomtact.json_values import plain, to_text
from geomtact.sensing.image_file import ImageFile, read_image, write_image

ROOT = Path(__file__).resolve().parents[1]
STRANGE = os.fsdecode(b"p\xfcr")  # Latin-1, which is no UTF-8
BOX = trimesh.creation.box((10.0, 8.0, 6.0))
CLAIMED = "from geomtact.cli.shell import claim_output, to_stderr; claim_output()\n"


def python(code, *options, **variables):
    """What a separate Python process writes to both streams, and its exit status."""
    done = subprocess.run(
        [sys.executable, *options, "-c", code], capture_output=True, cwd=ROOT, env={**os.environ, **variables}
    )
    return done.stdout.decode(), done.stderr.decode(), done.returncode


def textured(folder, name=STRANGE):
    """A box as PLY, OBJ and glTF that name pictures and materials which are not there."""
    ply, obj = folder / f"{name}.ply", folder / f"{name}.obj"
    BOX.export(folder / "box.ply")
    ply.write_bytes((folder / "box.ply").read_bytes().replace(b"comment", b"comment TextureFile no.png\ncomment", 1))
    assert b"TextureFile" in ply.read_bytes()
    obj.write_text("mtllib no.mtl\nusemtl no\n" + BOX.export(file_type="obj"))
    return ply, obj


def test_no_log_warning_or_line_of_c_code_shows():
    code = """
import logging, os, warnings
try:
    1 / 0
except ZeroDivisionError:
    logging.getLogger("library").warning("failed", exc_info=True)
logging.error("as well")
warnings.warn("and this")
os.write(2, b"corrupt data\\n")
os.system("echo a child of it >&2")
to_stderr("a line of geomtact")
"""
    assert python(CLAIMED + code) == ("", "a line of geomtact\n", 0)


def test_warnings_show_to_who_asks_for_them():
    assert "and this" in python(CLAIMED + "import warnings; warnings.warn('and this')", "-Wdefault")[1]


def test_errors_and_crashes_still_show():
    assert "ZeroDivisionError" in python(CLAIMED + "1 / 0")[1]
    _, printed, status = python(CLAIMED + "import os; os.abort()")
    assert status < 0
    assert "Fatal Python error: Aborted" in printed


def test_a_closed_standard_error_is_no_error():
    code = CLAIMED + "to_stderr('lost'); print('done')"
    done = subprocess.run(["sh", "-c", '"$0" -c "$1" 2>&-', sys.executable, code], capture_output=True, cwd=ROOT)
    assert (done.stdout, done.returncode) == (b"done\n", 0)


def test_a_backend_that_matplotlib_does_not_have_is_no_error():
    code = CLAIMED + "import matplotlib; print(matplotlib.get_backend().lower())"
    assert python(code, MPLBACKEND="foo") == ("agg\n", "", 0)


def test_loading_shows_nothing_and_leaves_logging_to_its_user(tmp_path):
    for path in textured(tmp_path):
        code = f"from geomtact import load_mesh; load_mesh({str(path)!r}, 'mm')"
        assert python(code) == ("", "", 0)
        code = f"import logging; logging.basicConfig(level=1); {code}; logging.getLogger('trimesh').error('seen')"
        assert python(code)[1].endswith("ERROR:trimesh:seen\n")


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "glb", "gltf"])
def test_a_mesh_of_any_name_loads(tmp_path, suffix):
    BOX.export(str(tmp_path / f"box.{suffix}"))
    path = (tmp_path / f"box.{suffix}").rename(tmp_path / f"{STRANGE}.{suffix}")
    mesh = load_mesh(path, None if suffix.startswith("gl") else "mm")
    assert mesh.name == r"p\udcfcr"
    assert len(mesh.faces) == 12


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tif", "npy"])
def test_an_image_of_any_name_is_read(tmp_path, suffix):
    path = tmp_path / f"{STRANGE}.{suffix}"
    pixels = np.zeros((5, 6, 3), np.uint8)
    if suffix == "npy":
        np.save(path, pixels)
    else:
        Image.fromarray(pixels).save(path)
    np.testing.assert_array_equal(read_image(path), pixels)


def test_unusual_names_are_printable_in_output_files(tmp_path):
    text = to_text(plain({STRANGE: [Path(STRANGE), STRANGE]}))
    assert json.dumps(json.loads(text), ensure_ascii=False).encode() == rb'{"p\\udcfcr": ["p\\udcfcr", "p\\udcfcr"]}'
    write_image(tmp_path / f"{STRANGE}.png", np.eye(4, dtype=bool), {"object": STRANGE})
    assert ImageFile.read(tmp_path / f"{STRANGE}.png").metadata["geomtact:object"] == r"p\udcfcr"


def test_a_command_is_quiet_about_missing_pictures_and_takes_any_name(tmp_path):
    ply, _ = textured(tmp_path)
    args = ["simulate", str(ply), "--unit", "mm", "--sensor", "gelsight-mini", "--out", str(tmp_path / STRANGE)]
    run = [sys.executable, "-m", "geomtact", *args]
    done = subprocess.run(run, capture_output=True, cwd=ROOT, env={**os.environ, "MPLBACKEND": "foo"})
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.decode().endswith("of the window in contact\n")
    assert (tmp_path / STRANGE / r"p\udcfcr_1.png").is_file()


@pytest.mark.slow
def test_preparation_is_quiet_about_missing_pictures_and_takes_any_name(tmp_path):
    pytest.importorskip("pymeshlab")
    ply, _ = textured(tmp_path)
    shutil.copy(ply, tmp_path / "plain.ply")
    run = [sys.executable, ROOT / "tools" / "prep_mesh.py", ply, "--unit", "mm", "--out", tmp_path / STRANGE, "--json"]
    done = subprocess.run(run, capture_output=True, cwd=ROOT, env={**os.environ, "MPLBACKEND": "foo"})
    assert done.returncode == 0
    first, following, *more = done.stderr.decode().splitlines()
    assert first.endswith("p\\udcfcr.ply: clean, in mm")
    assert following.startswith("next: geomtact localize IMAGE --object ")
    assert not more
    result = json.loads(done.stdout)["meshes"][0]
    assert (result["name"], result["faces"]) == (r"p\udcfcr", 12)
    written = sorted(path.name for path in (tmp_path / STRANGE).iterdir())
    assert written == [rf"p\udcfcr.{suffix}" for suffix in ("json", "ply", "png")]
