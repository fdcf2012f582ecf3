"""The unit of a mesh file: given, or stated by the file in exactly one form; never guessed, never two at once."""

import numpy as np
import pytest
import trimesh

from geomtact.cli.several import units_of
from geomtact.errors import MeshError
from geomtact.geometry.catalogue import catalogue
from geomtact.geometry.mesh_file import load_mesh
from geomtact.geometry.units import UNITS, stated_unit, unit_comment

BOX = trimesh.creation.box((2.0, 3.0, 5.0))


def commented(path, *comments):
    """A box's file with comment lines at its head."""
    BOX.export(str(path))
    head, mark = (b"ply", "comment ") if path.suffix == ".ply" else (b"", "# ")
    head = b"OFF" if path.suffix == ".off" else head
    lines = "".join(f"\n{mark}{comment}" for comment in comments).encode()
    path.write_bytes(head + lines + b"\n" * (not head) + path.read_bytes().removeprefix(head))
    return path


@pytest.mark.parametrize("suffix", ["ply", "obj", "off"])
@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_in_the_file_is_used_and_never_overruled(tmp_path, suffix, unit):
    path = commented(tmp_path / f"a.{suffix}", "made by hand", unit_comment(unit))
    for given in (None, unit, unit.upper()):
        mesh = load_mesh(path, given)
        assert mesh.unit == unit
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), np.multiply(UNITS[unit], [2, 3, 5]), rtol=1e-6)
    for other in set(UNITS) - {unit}:
        with pytest.raises(
            MeshError, match=f"states the unit {unit}, but the unit {other} was given; leave the unit out"
        ):
            load_mesh(path, other)


@pytest.mark.parametrize("suffix", ["ply", "obj", "off"])
@pytest.mark.parametrize(
    "comment",
    [
        "units: mm",
        "unit: mm, perhaps",
        "the unit: mm",
        "unit: MM",
        "unit mms",
        "unit = mm",
        "unit: km",
        "mm",
        "unit:",
        "scale 0.001",
    ],
)
def test_a_comment_of_another_form_states_nothing(tmp_path, suffix, comment):
    path = commented(tmp_path / f"a.{suffix}", comment)
    assert stated_unit(path) is None
    with pytest.raises(MeshError, match="does not state its unit; give --unit .unit=. mm, cm, m or inch"):
        load_mesh(path)
    assert load_mesh(path, "cm").unit == "cm"


@pytest.mark.parametrize(
    ("suffix", "head"),
    [
        ("obj", "mtllib x.mtl\no part\n{}\n"),
        ("obj", "\ufeff{}\n"),
        ("obj", "# made by hand\n\ng a\nvn 0 0 1\n   {}\n"),
        ("off", "OFF 8 12 18\n{}\n"),
        ("off", "OFF # a box\n8 12 18 # its counts\n{}\n"),
        ("off", "OFF\n8 12\n{}\n"),
        ("off", "OFF8\n12\n18\n{}\n"),
        ("off", "{}\noff\n8 12 18\n"),
        ("off", "8 12 18\n{}\n"),
        ("off", "\ufeff{}\nOFF\n8 12 18\n"),
    ],
)
def test_a_comment_before_the_first_vertex_states_the_unit(tmp_path, suffix, head):
    BOX.export(str(tmp_path / f"a.{suffix}"))
    path = tmp_path / f"a.{suffix}"
    lines = path.read_text().splitlines()
    body = [line for line in lines if line and line[0] not in "#o"] if suffix == "obj" else lines[2:]
    first, rest = body[0], "\n".join(body[1:])
    path.write_text(f"{head.format('# unit: inch')}{first}\n{rest}\n", "utf-8")
    assert load_mesh(path).unit == "inch" and len(load_mesh(path).faces) == 12
    with pytest.raises(MeshError, match="states the unit inch, but the unit mm was given"):
        load_mesh(path, "mm")
    behind = head.replace("{}\n", "").format()
    path.write_text(f"{behind}{first}\n# unit: inch\n{rest}\n", "utf-8")
    assert stated_unit(path) is None and load_mesh(path, "mm").unit == "mm"


def test_a_comment_behind_the_head_states_nothing(tmp_path):
    path = commented(tmp_path / "a.obj")
    path.write_text(path.read_text() + "\n# unit: mm\n")
    assert stated_unit(path) is None
    path = commented(tmp_path / "a.ply", "obj_info unit: mm")
    path.write_bytes(path.read_bytes() + b"\ncomment unit: mm\n")
    assert stated_unit(path) is None


def test_two_units_in_one_file_are_refused(tmp_path):
    path = commented(tmp_path / "a.ply", "unit: mm", "unit: inch")
    with pytest.raises(MeshError, match="state two units, inch and mm; remove the wrong one"):
        load_mesh(path, "mm")


@pytest.mark.parametrize(
    ("word", "unit"), [("millimeters", "mm"), ("centimeters", "cm"), ("meters", "m"), ("inches", "inch")]
)
def test_sketchup_states_its_unit_in_obj(tmp_path, word, unit):
    comments = ("Alias OBJ Model File", "Exported from SketchUp", f"File units = {word}")
    assert load_mesh(commented(tmp_path / "a.obj", *comments)).unit == unit
    assert stated_unit(commented(tmp_path / "a.ply", *comments)) is None


def test_an_unsupported_unit_is_named(tmp_path):
    path = commented(tmp_path / "a.obj", "File units = feet")
    with pytest.raises(MeshError, match="states the unit feet; export it in one of mm, cm, m, inch"):
        load_mesh(path, "m")


def test_of_several_objects_the_unit_is_for_those_that_need_one(tmp_path):
    for name in ("a.stl", "b.glb", "c.ply"):
        BOX.export(str(tmp_path / name))
    stl, glb, ply = (str(tmp_path / name) for name in ("a.stl", "b.glb", "c.ply"))
    inch = str(commented(tmp_path / "d.ply", "unit: inch"))
    pin = str(catalogue()["pin"].file)
    assert units_of([stl, glb, ply, inch, pin, "pin"], "cm") == ["cm", None, "cm", None, None, None]
    assert units_of([stl, "missing.glb", "missing.stl"], "cm") == ["cm", None, "cm"]
    # where none needs it, it is checked as for one alone
    assert units_of([glb, inch, "pin"], "mm") == ["mm", "mm", "mm"]
    assert units_of([None], None) == [None]
