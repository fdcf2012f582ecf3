"""The command line: exit statuses, one-line errors, where options come from, and what lands in files and on the screen."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import trimesh
import typer
from PIL import Image
from typer.testing import CliRunner

from geomtact import load_mesh, se3
from geomtact.cli import app, main, project
from geomtact.cli.options import approach_from
from geomtact.cli.shell import one_line_errors, one_line_usage_errors
from geomtact.errors import CacheError, InputError, UsageError
from geomtact.sensing import reading
from geomtact.sensing.image_file import ImageFile
from tools.studies.__main__ import COMMANDS
from tools.studies.__main__ import app as studies
from tools.studies.__main__ import main as run_study


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A cache that this module's tests share, so that the ball's index is built once."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def geomtact(tmp_path, monkeypatch, cache, few_touches):
    """Runs a command in an empty folder; checks the exit status."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GEOMTACT_CACHE", str(cache))
    monkeypatch.setattr("geomtact.contact_space.resolution.MAX_POSES", 3000)

    def run(*args, status=0, of=app):
        result = CliRunner().invoke(of, [str(a) for a in args])
        assert result.exit_code == status, f"exit status {result.exit_code}: {result.output} {result.exception!r}"
        if status == 3:
            assert result.stderr.startswith("error: ")
            assert result.stderr.count("\n") == 1
            assert "Traceback" not in result.output
        return result

    return run


@pytest.fixture(scope="module")
def touched(tmp_path_factory):
    """A folder with two simulated touches of the ball on the GelSight Mini."""
    folder = tmp_path_factory.mktemp("touched")
    args = ["simulate", "ball", "--sensor", "gelsight-mini", "--n", "2", "--seed", "3", "--out", str(folder)]
    result = CliRunner().invoke(app, args)
    assert result.exit_code == 0, result.output
    return folder


def test_help_and_lists(geomtact):
    commands = {
        "localize",
        "prepare",
        "evaluate",
        "train",
        "simulate",
        "sensors",
        "objects",
        "cache",
        "next-touch",
        "track",
        "calibrate",
        "view",
    }
    assert {c.name or c.callback.__name__ for c in app.registered_commands} == commands
    assert all(name in geomtact("--help").stdout for name in commands)
    assert geomtact("--version").stdout.startswith("geomtact ")
    assert "gelsight-mini" in geomtact("sensors").stdout
    listed = geomtact("objects").stdout
    assert "elbow_pipe" in listed
    assert "[mm]" in listed
    assert "0 indexes" in geomtact("cache", "--cache-dir", "nowhere").stdout


@pytest.mark.parametrize(
    "args", [["localize"], ["prepare", "--unknown"], ["localise"], ["simulate", "pin", "--n", "0"]]
)
def test_usage_errors_exit_2(geomtact, args):
    geomtact(*args, status=2)


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["localise"], "did you mean 'localize'?; run 'geomtact --help'"),
        (["localize", "--nope"], "no such option: --nope; run 'geomtact localize --help'"),
        (["simulate", "pin", "--n", "0"], "'--n'"),
        (["simulate", "pin", "--out", ""], "expected a value after --out, got an empty text"),
    ],
)
def test_a_usage_error_is_one_line(args, said, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["geomtact", *args])
    with pytest.raises(SystemExit) as stopped:
        main()
    printed = capsys.readouterr()
    assert stopped.value.code == 2 and printed.out == ""
    assert printed.err.startswith("error: ") and printed.err.count("\n") == 1 and said.lower() in printed.err.lower()


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["scores", "--effort", "best"], "'balanced'"),
        (["score"], "did you mean 'scores'?"),
        (["localize"], "missing argument 'OBJECT...'"),
        (["localize", "--nope"], "no such option: --nope"),
        (["touches", "--touches", "0"], "'--touches'"),
        (["touches", "--out", ""], "after --out"),
    ],
)
def test_usage_errors_of_studies_are_one_line(args, said, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["python -m tools.studies", *args])
    with pytest.raises(SystemExit) as stopped:
        run_study()
    printed = capsys.readouterr()
    assert stopped.value.code == 2 and printed.out == ""
    assert printed.err.startswith("error: ") and printed.err.count("\n") == 1 and said.lower() in printed.err.lower()


def test_the_process_exits_with_the_status_of_its_command(monkeypatch, capsys):
    for args, status in ((["--version"], 0), (["objects"], 0), ([], 2), (["prepare", "pim", "--sensor", "gelslim"], 3)):
        monkeypatch.setattr("sys.argv", ["geomtact", *args])
        with pytest.raises(SystemExit) as stopped:
            main()
        assert (stopped.value.code or 0) == status, args
        capsys.readouterr()


def test_missing_options_are_named_with_their_choices(geomtact, tmp_path):
    Image.fromarray(np.zeros((240, 320), np.uint8)).save("plain.png")
    printed = geomtact("localize", "plain.png", status=2).stderr
    assert "--object" in printed
    assert "pin" in printed
    printed = geomtact("localize", "plain.png", "--object", "pin", status=2).stderr
    assert "--sensor" in printed
    assert "gelsight-mini" in printed


def test_bad_input_exits_3_with_one_line(geomtact, tmp_path):
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.png").write_text("no image")
    for image in ("absent.png", "empty.png", "text.png"):
        geomtact("localize", image, "--object", "ball", "--sensor", "gelsight-mini", status=3)
    assert "'pin'" in geomtact("prepare", "pim", "--sensor", "gelslim", status=3).stderr
    assert "'gelslim'" in geomtact("prepare", "pin", "--sensor", "gelslem", status=3).stderr
    (tmp_path / "geomtact.toml").write_text('objekt = "pin"')
    assert "'object'" in geomtact("prepare", status=3).stderr


def test_an_unknown_object_is_one_line_in_every_study(geomtact):
    for study in COMMANDS:
        assert study in geomtact(status=2, of=studies).output
        more = ["out.png"] if study == "plot" else []  # it takes a study's file
        assert "pim" in geomtact(study, "pim", *more, status=3, of=studies).stderr


def test_wrong_names_and_paths_are_errors_before_any_work(geomtact, touched, tmp_path):
    image = touched / "ball_1.png"
    (tmp_path / "part.stl").touch()
    assert (
        "--effort: no effort named 'fsat'; did you mean 'fast'?"
        in geomtact("localize", image, "--effort", "fsat", status=2).stderr
    )
    assert "'mask'" in geomtact("localize", image, "--kind", "maks", status=2).stderr
    assert "'png'" in geomtact("localize", image, "--out", "out", "--report", "pgn", status=2).stderr
    assert "--report needs --out" in geomtact("localize", image, "--report", "png", status=2).stderr
    assert "is a file; give a folder" in geomtact("localize", image, "--out", "part.stl", status=2).stderr
    assert "is a file; give a folder" in geomtact("simulate", "ball", "--out", "part.stl", status=2).stderr
    assert "got a folder; give the images in it" in geomtact("localize", str(tmp_path), status=3).stderr
    assert "no.npz: no such file" in geomtact("localize", image, "--prior", "no.npz", status=3).stderr
    assert "no.toml: no such file" in geomtact("localize", image, "--sensor", "no.toml", status=3).stderr
    (tmp_path / "geomtact.toml").write_text('effort = "quick"')
    printed = geomtact("localize", image, status=3).stderr
    assert "geomtact.toml: no effort named 'quick'" in printed
    assert "(known: balanced, exact, fast)" in printed


def test_an_image_is_no_prior(tmp_path, touched):
    from geomtact import Posterior

    with pytest.raises(InputError, match="ball_1.png: not a posterior that geomtact saved") as error:
        Posterior.load(touched / "ball_1.png")
    assert "pickle" not in str(error.value)


def test_progress_without_a_terminal_is_a_line_each_tenth(capsys):
    from geomtact.cli.shell import progress_bar

    with progress_bar("preparing pin") as progress:
        for k in range(1001):
            progress(k / 1000, "simulating touches")
        progress(0.5, "fitting")
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "preparing pin: simulating touches, 0 %"
    assert lines[10:] == ["preparing pin: simulating touches, 100 %", "preparing pin: fitting, 50 %"]


def test_system_errors_are_one_line_too(geomtact, tmp_path):
    (tmp_path / "file").touch()
    printed = geomtact("simulate", "ball", "--sensor", "gelslim", "--out", tmp_path / "file" / "below", status=3).stderr
    assert "file" in printed


def test_simulated_images_carry_their_object_and_sensor(touched):
    for k in (1, 2):
        truth = json.loads((touched / f"ball_{k}.json").read_text())
        with Image.open(touched / f"ball_{k}.png") as image:
            assert image.size == (320, 240)
            assert set(np.unique(image)) == {0, 255}
            assert image.text["geomtact:object"] == "ball"
            assert image.text["geomtact:sensor"] == "gelsight-mini"
            assert json.loads(image.text["geomtact:T_sensor_object"]) == truth["T_sensor_object"]
        se3.check_transforms(truth["T_sensor_object"])
        assert 0.3 <= truth["penetration_mm"] <= 1.5


def test_assumptions_made_in_loading_a_mesh_are_printed(geomtact, tmp_path):
    (tmp_path / "ball.stl").write_bytes(load_mesh("ball").path.read_bytes() + b"end")
    done = geomtact("simulate", "ball.stl", "--unit", "mm", "--sensor", "digit", "--n", 1, "--out", tmp_path / "out")
    assert "warning: ball.stl: 3 bytes after the last triangle are passed over" in done.stderr


def test_simulate_is_repeatable_and_replays_a_pose(geomtact, touched, tmp_path):
    geomtact("simulate", "ball", "--sensor", "gelsight-mini", "--n", 2, "--seed", 3, "--out", tmp_path / "again")
    for file in touched.iterdir():
        assert file.read_bytes() == (tmp_path / "again" / file.name).read_bytes()
    geomtact("simulate", "ball", "--sensor", "gelsight-mini", "--pose", touched / "ball_2.json", "--out", tmp_path)
    with Image.open(touched / "ball_2.png") as a, Image.open(tmp_path / "ball_1.png") as b:
        assert np.array_equal(a, b)
    (tmp_path / "pose.json").write_text(json.dumps(np.diag([1.0, 1, 1, 1]).tolist()).replace("0.0]", "9.0]", 1))
    far = ("simulate", "ball", "--sensor", "gelslim", "--pose", tmp_path / "pose.json", "--out", tmp_path / "far")
    assert "the object does not touch at this pose" in geomtact(*far).stderr
    assert "give one of them" in geomtact(*far, "--n", 2, status=2).stderr
    assert json.loads((tmp_path / "far" / "ball_1.json").read_text())["penetration_mm"] is None
    (tmp_path / "pose.json").write_text('{"T_sensor_object": [[1, 2], [3, 4]]}')
    geomtact("simulate", "ball", "--sensor", "gelslim", "--pose", tmp_path / "pose.json", status=3)
    (tmp_path / "pose.json").write_text("no json")
    geomtact("simulate", "ball", "--sensor", "gelslim", "--pose", tmp_path / "pose.json", status=3)


@pytest.mark.parametrize(
    ("size_mm", "share", "why"),
    [
        (40, "100.0 %", "the contact fills the window, so no slope changes the colours; touch an edge"),
        (11, "41.3 %", "by its colours"),
        (5, "8.4 %", None),
    ],
)
def test_a_tactile_image_that_does_not_show_its_contact_brings_a_warning(geomtact, tmp_path, size_mm, share, why):
    """A flat face moves the gel around it alone; localize reads such an image inverted, or as empty."""
    trimesh.creation.box((size_mm, size_mm, 10)).export(tmp_path / "block.stl")
    (tmp_path / "pose.json").write_text(json.dumps(se3.transform(np.eye(3), [1e-3, 0, 4.5e-3]).tolist()))
    block = ("block.stl", "--unit", "mm", "--sensor", "gelsight-mini", "--pose", "pose.json", "--out", "out")
    done = geomtact("simulate", *block, "--tactile-image")
    assert f"block_1.png: {share} of the window in contact" in done.stdout
    if why is None:
        assert done.stderr == ""
    else:
        (warning,) = done.stderr.splitlines()
        assert warning.startswith(f"warning: out/block_1.png: localize would not find this contact: {why}")
    assert geomtact("simulate", *block).stderr == "overwritten: out/block_1.png, out/block_1.json\n"


def test_the_contact_face_may_be_given(geomtact, flat_nut, a_touch, tmp_path):
    Image.fromarray(255 * a_touch(flat_nut)[1].astype(np.uint8)).save(tmp_path / "nut.png")
    own = ("--cache-dir", tmp_path / "own")  # others count what the shared one holds
    nut = ("nut.png", "--object", "hex_nut", "--sensor", "gelsight-mini", "--scorer", "moments", *own)
    said = json.loads(geomtact("localize", *nut, "--approach", "0,0,1", "--json").stdout)
    assert said["settings"]["approach"] == [[[0, 0, 1], 0]]
    assert "ready" in geomtact("prepare", *nut[2:], "--approach", "-0.0,0,2").stdout
    assert approach_from(["0,0,1:3", "-1,0,0:0.5"]) == [([0, 0, 1], np.deg2rad(3)), ([-1, 0, 0], np.deg2rad(0.5))]
    assert approach_from(None) is None
    for wrong in ("0,0,a", "up", "0,0,1:x", "0,0,1:", "0,1", ""):
        with pytest.raises(UsageError, match="such as 0,0,1 or 0,0,1:5"):
            approach_from([wrong])
    for wrong, why in (("0,0,1:-3", "0 to 180 degrees"), ("0,0,1:400", "0 to 180 degrees"), ("0,0,0", "no length")):
        with pytest.raises(UsageError, match=why):
            approach_from([wrong])
    assert "three numbers" in geomtact("localize", *nut, "--approach", "0,1", status=2).stderr
    assert (
        "exactly one object"
        in geomtact("localize", *nut[:2], "hex_nut,pin", *nut[3:], "--approach", "0,0,1", status=2).stderr
    )


def test_localize_takes_all_from_the_image_and_writes_everything(geomtact, touched, tmp_path, cache):
    printed = geomtact("localize", touched / "ball_1.png", "--out", "out")
    assert "object: ball (from the image's metadata)" in printed.stderr
    assert "sensor: gelsight-mini (from the image's metadata)" in printed.stderr
    assert "probability" in printed.stdout
    written = sorted(p.name for p in (tmp_path / "out").iterdir())
    assert written == ["posterior.npz", "report.html", "report.png", "result.json"]
    content = json.loads((tmp_path / "out" / "result.json").read_text())
    truth = json.loads((touched / "ball_1.json").read_text())
    # the ball's own origin is its centre; its contact is cut off by the border, so that neighbouring modes share the mass
    centres = np.array([mode["T"] for mode in content["modes"]])[:, :2, 3]
    off = np.linalg.norm(centres - np.array(truth["T_sensor_object"])[:2, 3], axis=1)
    assert off.min() < 1e-3 and off[0] < 2.5e-3
    assert content["settings"]["seed"] == 0

    # only JSON on standard output, and the index comes from the cache now
    again = geomtact("localize", touched / "ball_1.png", "--json", "--seed", 0, "--report", "none")
    assert json.loads(again.stdout)["modes"] == content["modes"]

    for wanted, written in (("png", {"report.png"}), ("html", {"report.html"}), ("none", set())):
        printed = geomtact("localize", touched / "ball_1.png", "--out", wanted, "--report", wanted).stdout
        assert {p.name for p in (tmp_path / wanted).iterdir()} == {"posterior.npz", "result.json"} | written
        assert all((name in printed) == (name in written) for name in ("report.png", "report.html"))

    shutil.copytree(cache, tmp_path / "copy")
    assert "ball" in geomtact("cache", "--cache-dir", "copy").stdout
    assert "1 index," in geomtact("cache", "--cache-dir", "copy", "--limit-gb", 1).stdout
    assert "did you mean 'ball'?" in geomtact("cache", "--cache-dir", "copy", "--remove", "bell", status=2).stderr
    assert "0 indexes" in geomtact("cache", "--cache-dir", "copy", "--remove", "ball").stdout
    assert "0 indexes" in geomtact("cache", "--cache-dir", "copy", "--clear").stdout
    geomtact("cache", "--clear", "--limit-gb", 1, status=2)


def test_localize_reads_each_image_once(geomtact, touched, tmp_path, monkeypatch):
    """For one sensor and for two, though a bad image is reported before an index is prepared."""
    opened, read = [], ImageFile.read
    monkeypatch.setattr(ImageFile, "read", lambda path: opened.append(path.name) or read(path))
    geomtact("localize", touched / "ball_1.png", "--effort", "fast")
    assert opened == ["ball_1.png"]
    opened.clear()
    at = [json.loads((touched / f"ball_{k}.json").read_text())["T_sensor_object"] for k in (1, 2)]
    content = {"T_world_sensor": [np.linalg.inv(T).tolist() for T in at]}
    (tmp_path / "poses.json").write_text(json.dumps(content))
    both = [touched / f"ball_{k}.png" for k in (1, 2)]
    geomtact("localize", *both, "--sensor-poses", "poses.json", "--effort", "fast")
    assert opened == ["ball_1.png", "ball_2.png"]


def test_images_and_folders_may_have_any_name(geomtact, touched, tmp_path):
    name = os.fsdecode(b"t\xfcr")
    image = shutil.copy(touched / "ball_1.png", tmp_path / f"{name}.png")
    printed = geomtact("localize", image, "--out", name, "--json")
    assert json.loads(printed.stdout)["settings"]["image"] == str(tmp_path / r"t\udcfcr.png")
    assert (tmp_path / name / "result.json").read_text("utf-8") == printed.stdout
    assert r"t\udcfcr.png" in (tmp_path / name / "report.html").read_text("utf-8")
    assert geomtact("localize", image, "--prior", name, "--json").stdout.startswith("{")
    film = shutil.copy(image, tmp_path / f"{name}.avi")
    printed = geomtact("track", film, "--object", "ball", "--sensor", "gelsight-mini", status=3).stderr
    assert "the name of a video must be UTF-8; rename it" in printed


def test_no_contact_exits_4_and_writes_its_result(geomtact, tmp_path):
    Image.fromarray(np.zeros((240, 320), np.uint8)).save("nothing.png")
    args = ["nothing.png", "--object", "ball", "--sensor", "gelsight-mini", "--kind", "mask", "--out", "out", "--json"]
    printed = geomtact("localize", *args, status=4)
    assert json.loads(printed.stdout)["contact"] is False
    assert json.loads((tmp_path / "out" / "result.json").read_text())["modes"] == []


def test_geomtact_toml_takes_precedence_over_the_metadata(tmp_path):
    (tmp_path / "geomtact.toml").write_text('object = "part.stl"\nunit = "mm"\nsensor = "gelslim"\n')
    (tmp_path / "part.stl").touch()
    below = tmp_path / "a" / "b"
    below.mkdir(parents=True)
    metadata = {"geomtact:object": "pin", "geomtact:sensor": "digit"}
    nothing = {"object": None, "unit": None, "sensor": None}

    values, sources = project.resolve(nothing, metadata, below)
    assert values == {"object": str(tmp_path / "part.stl"), "unit": "mm", "sensor": "gelslim"}
    assert set(sources.values()) == {str(tmp_path / "geomtact.toml")}

    values, sources = project.resolve({**nothing, "object": "head"}, metadata, below)
    assert values == {"object": "head", "unit": None, "sensor": "gelslim"}  # the unit is of the file's own object

    (tmp_path / "geomtact.toml").write_text('unit = "mm"\n')
    values, sources = project.resolve({**nothing, "object": "head.stl"}, metadata, below)
    assert values == {"object": "head.stl", "unit": "mm", "sensor": "digit"}
    assert sources["sensor"] == "the image's metadata"

    metadata["geomtact:unit"] = "inch"
    (tmp_path / "geomtact.toml").write_text("")
    assert project.resolve({**nothing, "object": "head.stl"}, metadata, below)[0]["unit"] is None
    assert project.resolve(nothing, metadata, below)[0] == {"object": "pin", "unit": "inch", "sensor": "digit"}

    (below / "geomtact.toml").write_text('sensor = "gelsight-mini"\n')
    assert project.resolve(nothing, {}, below)[0] == {"object": None, "unit": None, "sensor": "gelsight-mini"}


def test_a_bundled_name_takes_precedence_over_a_file(tmp_path):
    (tmp_path / "ball").mkdir()
    (tmp_path / "digit").write_text("")
    (tmp_path / "geomtact.toml").write_text('object = "ball"\nsensor = "digit"\n')
    assert project.read(tmp_path / "geomtact.toml") == {"object": "ball", "sensor": "digit"}


def test_a_file_in_the_home_folder_may_be_named(tmp_path, monkeypatch):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "part.stl").touch()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "geomtact.toml").write_text('object = "~/part.stl"\n')
    assert project.read(tmp_path / "geomtact.toml") == {"object": str(tmp_path / "home" / "part.stl")}
    (tmp_path / "geomtact.toml").write_text('object = "~nobody_of_that_name/part.stl"\nbackground = "gel.png"\n')
    # an image is a file beside this one, whether it is there or not; an object may be a name
    expected = {"object": "~nobody_of_that_name/part.stl", "background": str(tmp_path / "gel.png")}
    assert project.read(tmp_path / "geomtact.toml") == expected


@pytest.mark.parametrize(
    "text, expected",
    [("sensr = 'x'", "'sensor'"), ("unit = 3", "text in quotes"), ("= =", "TOML"), ("object = ''", "object is empty")],
)
def test_a_wrong_geomtact_toml_is_named(tmp_path, text, expected):
    (tmp_path / "geomtact.toml").write_text(text)
    with pytest.raises(InputError, match="geomtact.toml.*" + expected):
        project.read(tmp_path / "geomtact.toml")


@pytest.mark.parametrize(
    "error, status", [(UsageError("a\nb"), 2), (CacheError("full"), 3), (OSError(28, "No space"), 3)]
)
def test_statuses_of_errors(error, status, capsys):
    import typer

    from geomtact.cli.shell import one_line_errors

    def command():
        raise error

    with pytest.raises(typer.Exit) as stopped:
        one_line_errors(command)()
    assert stopped.value.exit_code == status
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    assert captured.out == ""


@pytest.mark.parametrize("error", ["typer.Abort", "EOFError"])
def test_an_aborted_command_is_one_line(error, monkeypatch, capsys):
    from geomtact.cli.shell import one_line_usage_errors

    with pytest.raises(SystemExit) as stopped, one_line_usage_errors():
        raise {"typer.Abort": typer.Abort, "EOFError": EOFError}[error]
    assert stopped.value.code == 1 and capsys.readouterr().err.count("\n") == 1


def test_interrupt_exits_130_without_a_traceback():
    code = (
        "import geomtact.cli as c\n"
        "def command(): raise KeyboardInterrupt\n"
        "c.app.command('stop')(c.one_line_errors(command))\n"
        "import sys; sys.argv = ['geomtact', 'stop']\n"
        "c.main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 130
    assert "Traceback" not in done.stderr


def test_each_image_may_have_its_own_background(tmp_path, monkeypatch, rng):
    monkeypatch.chdir(tmp_path)
    read_observation, given = reading.read_observation, []

    def noted(image, sensor, kind, background):
        given.append((image.path.name, background))
        return read_observation(image, sensor, kind, background)

    def refused(*_, **__):
        raise InputError("far enough")

    monkeypatch.setattr(reading, "read_observation", noted)
    monkeypatch.setattr("geomtact.identification.identify", refused)
    for name in ("a", "b", "rest_a", "rest_b"):
        Image.fromarray(rng.integers(100, 110, (320, 427, 3)).astype(np.uint8)).save(f"{name}.png")
    (tmp_path / "poses.json").write_text(
        json.dumps({"T_world_sensor": [np.eye(4).tolist(), np.diag([1, -1, -1, 1]).tolist()]})
    )
    run = ["localize", "a.png", "b.png", "--object", "ball", "--sensor", "gelslim", "--sensor-poses", "poses.json"]
    both = ["--background", "rest_a.png", "--background", "rest_b.png"]
    assert "far enough" in CliRunner().invoke(app, [*run, *both]).output
    assert given == [("a.png", "rest_a.png"), ("b.png", "rest_b.png")]
    CliRunner().invoke(app, [*run, *both[:2]])
    assert given[2:] == [("a.png", "rest_a.png"), ("b.png", "rest_a.png")]
    refused = CliRunner().invoke(app, [*run, *both, *both[:2]])
    assert refused.exit_code == 2 and "expected one, or one for each of 2 images, got 3" in " ".join(
        refused.output.split()
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("prepare", "ball", "--max-poses", "5"), "expected at least 1000"),
        (("prepare", "ball", "--max-poses", "x"), "expected a whole number"),
        (("localize", "--efort", "fast"), "no such option: --efort; did you mean '--effort'?"),
    ],
)
def test_usage_errors_are_in_plain_words(words, message, capsys):
    with pytest.raises(SystemExit), one_line_usage_errors():
        app(list(words), standalone_mode=False)
    printed = capsys.readouterr().err
    assert message in printed and "Input should" not in printed and "ossible options" not in printed


def test_a_folder_of_sensor_poses_and_a_truncated_file_are_named_as_such(geomtact, touched, tmp_path):
    image = touched / "ball_1.png"
    assert "is a folder; give a JSON file" in geomtact("localize", image, "--sensor-poses", tmp_path, status=3).stderr
    (tmp_path / "cut.json").write_text('{"T_world')
    printed = geomtact("localize", image, "--sensor-poses", tmp_path / "cut.json", status=3).stderr
    assert "cannot be read as JSON" in printed and "UTF-8" not in printed


def test_an_interrupted_command_says_so(capsys):
    def stopped():
        raise KeyboardInterrupt

    with pytest.raises(typer.Exit) as left:
        one_line_errors(stopped)()
    assert left.value.exit_code == 130 and capsys.readouterr().err == "interrupted\n"
