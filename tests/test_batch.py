"""Laws of many tasks: the files are the same however they are made, and a process that is killed loses its own task alone."""

import hashlib
import inspect
import json
import os
import signal
import threading
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from geomtact.batch import prepare_part, run_all
from geomtact.cli import app
from geomtact.errors import InputError, UsageError
from geomtact.scoring import fitted
from geomtact.sensing.sensor import Sensor
from tools.studies.__main__ import COMMANDS
from tools.studies.__main__ import app as studies

PARTS = ("ball", "hex_nut")
TOUCHES = fitted.TOUCHES  # of another test, for as long as it lasts, there are fewer


def written(folder: Path) -> dict:
    """The hash of every file of a cache, but for what a killed process has left half made."""
    whole = (
        path
        for path in folder.rglob("*")
        if path.is_file() and not str(path.relative_to(folder)).startswith("building-")
    )
    files = sorted(path for path in whole if not path.name.startswith("."))
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def tasks(folder: Path) -> list:
    """Objects on a sensor of so few pixels that preparing takes no time."""
    sensor = Sensor("coarse", (40, 30), (0.5e-3, 0.5e-3), 0.0, 2e-3)
    return [(name, None, sensor, "moments", 1000, folder) for name in PARTS]


def note(folder: Path, name: str, once: str) -> None:
    """Writes a file; refuses "bad", fails at "full", dies at "deadly", and where it is the first to do ``once``."""
    if name == "bad":
        raise InputError("bad: no such part")
    if name == "full":
        raise OSError("no space left")
    first = folder / "killed"
    if name == once and not first.exists():
        first.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if name == "deadly":
        os.kill(os.getpid(), signal.SIGKILL)
    (folder / name).write_text(name)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """What one process after the other writes, its scores fitted on as many touches as those of other processes."""
    folder = tmp_path_factory.mktemp("alone")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitted, "TOUCHES", TOUCHES)
        found = list(run_all(prepare_part, tasks(folder)))
    assert [number for number, error in found if error is None] == [0, 1]
    return written(folder)


@pytest.mark.slow
def test_two_processes_write_the_same_bytes_as_one(alone, tmp_path):
    assert sorted(run_all(prepare_part, tasks(tmp_path), 2)) == [(0, None), (1, None)]
    assert written(tmp_path) == alone and len(alone) > 3 * len(PARTS)


def test_existing_results_are_not_recomputed(few_touches, tmp_path):
    (only,) = tasks(tmp_path)[:1]
    list(run_all(prepare_part, [only]))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npy")}
    list(run_all(prepare_part, [only]))
    assert before and before == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npy")}


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_task_that_cannot_be_done_is_named_and_the_others_are_done(tmp_path, jobs):
    errors = dict(run_all(note, [(tmp_path, name, "") for name in ("a", "bad", "full", "b")], jobs))
    assert errors[0] is None and errors[3] is None
    assert str(errors[1]) == "bad: no such part" and str(errors[2]) == "OSError: no space left"
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b"}


def test_a_killed_process_loses_only_its_task_which_is_repeated(tmp_path):
    names = [f"task {i}" for i in range(4)]
    errors = dict(run_all(note, [(tmp_path, name, "task 2") for name in names], 2))
    assert errors == dict.fromkeys(range(4))
    assert {path.name for path in tmp_path.iterdir()} == {*names, "killed"}


@pytest.mark.slow
def test_a_task_that_kills_every_process_is_given_up_alone(tmp_path):
    errors = dict(run_all(note, [(tmp_path, name, "") for name in ("deadly", "a", "b")], 2))
    assert "died three times" in str(errors.pop(0))
    assert errors == {1: None, 2: None}
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b"}


@pytest.mark.studies
def test_a_study_of_objects_in_parallel_equals_the_serial_study(few_touches, tmp_path, cache_dir):
    """Also where some are evaluated already."""

    def evaluate(out: Path, parts: tuple, *words: str) -> dict:
        options = ["--touches", "1", "--sweep", "noise", "--max-poses", "3000", "--cache-dir", str(cache_dir)]
        done = CliRunner().invoke(studies, ["stability", *parts, *options, "--out", str(out), *words])
        assert done.exit_code == 0, done.output
        return json.loads(out.read_text())

    apart, one_after_the_other = tmp_path / "apart.json", tmp_path / "one.json"
    expected = evaluate(one_after_the_other, PARTS)
    evaluate(apart, PARTS[:1])
    assert evaluate(apart, PARTS, "--jobs", "2") == expected
    assert {path.name for path in tmp_path.iterdir()} == {"apart.json", "one.json"}


@pytest.mark.studies
def test_scores_of_objects_in_parallel_equal_the_serial_scores(few_touches, tmp_path, cache_dir):
    """With the score that the command line names among the objects."""

    def evaluate(out: Path, *words: str) -> tuple[dict, dict]:
        options = ["--touches", "3", "--max-poses", "3000", "--cache-dir", str(cache_dir), "--out", str(out)]
        done = CliRunner().invoke(studies, ["scores", *PARTS, "--scores", "l1", "iou", *options, *words])
        assert done.exit_code == 0, done.output
        content = json.loads(out.read_text())
        outcomes = {
            (object_, name, i): {key: value for key, value in outcome.items() if key not in ("ms", "score_ms")}
            for object_, entry in content["parts"].items()
            for name, score in entry["scores"].items()
            for i, outcome in enumerate(score["outcomes"])
        }
        return outcomes, content["settings"]

    found = evaluate(tmp_path / "apart.json", "--jobs", "1")
    assert found == evaluate(tmp_path / "one.json") and len(found[0]) == 2 * 2 * 3


@pytest.mark.studies
def test_every_study_by_object_names_an_object_that_it_cannot_evaluate(tmp_path):
    by_object = [name for name, study in COMMANDS.items() if "ray" in inspect.signature(study).parameters]
    assert len(by_object) >= 10
    for study in by_object:
        out = tmp_path / f"{study}.json"
        done = CliRunner().invoke(studies, [study, "pim", "--jobs", "1", "--out", str(out)])
        assert done.exit_code == 3 and "pim: not judged" in done.output, (study, done.output)


@pytest.mark.studies
def test_a_parallel_study_keeps_its_results_and_names_the_failures(few_touches, tmp_path, cache_dir):
    out = tmp_path / "study.json"
    words = ["stability", PARTS[0], "pim", "--touches", "1", "--sweep", "noise", "--max-poses", "3000"]
    done = CliRunner().invoke(studies, [*words, "--jobs", "1", "--cache-dir", str(cache_dir), "--out", str(out)])
    assert done.exit_code == 3 and "1 of 2 objects are not judged" in done.output and "pim: not judged" in done.output
    assert list(json.loads(out.read_text())["parts"]) == [PARTS[0]]
    (kept := tmp_path / "study.parts" / "mine.txt").write_text("mine")
    again = [*words[:2], *words[3:], "--jobs", "1", "--cache-dir", str(cache_dir), "--out", str(out)]
    assert CliRunner().invoke(studies, again).exit_code == 0 and kept.read_text() == "mine"
    twice = CliRunner().invoke(studies, [*again[:2], f"elsewhere/{PARTS[0]}.stl", *again[2:]])
    assert twice.exit_code == 2 and f"two parts are named '{PARTS[0]}'" in twice.output
    without = CliRunner().invoke(studies, [*words, "--jobs", "2"])
    assert without.exit_code == 2 and "--out" in without.output


@pytest.mark.slow
def test_two_nodes_of_which_one_is_killed_write_the_same_bytes_as_one_process(alone, tmp_path):
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        other = cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        killed_at: list[int] = []

        def kill() -> None:
            while len(list(tmp_path.glob("*.lock"))) < len(PARTS):  # each node is at an object
                time.sleep(0.02)
            cluster.remove_node(other, allow_graceful=False)
            killed_at.append(len(written(tmp_path)))

        killer = threading.Thread(target=kill)
        killer.start()
        assert dict(run_all(prepare_part, tasks(tmp_path), ray=cluster.address)) == {0: None, 1: None}
        killer.join()
        assert killed_at[0] < len(alone)  # midway
        cluster.wait_for_nodes(timeout=60)  # until the one that is left alone is alive
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert written(tmp_path) == alone


def test_an_address_without_a_cluster_is_named():
    pytest.importorskip("ray")
    with pytest.raises(UsageError, match="ray start --head"):
        list(run_all(note, [("", "a", "")], ray="127.0.0.1:1"))


@pytest.mark.slow
def test_the_command_prepares_several_objects_and_names_the_failures(few_touches, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.stl").write_text("no mesh")
    words = [
        "prepare",
        "ball",
        "broken.stl",
        "hex_nut",
        "--sensor",
        "gelsight-mini",
        "--scorer",
        "moments",
        "--max-poses",
        "3000",
    ]
    done = CliRunner().invoke(app, [*words, "--unit", "mm", "--jobs", "1", "--cache-dir", "cache"])
    assert done.exit_code == 3, done.output
    assert "[1 of 3] ball on gelsight-mini: prepared" in done.output
    assert "broken.stl on gelsight-mini: not prepared" in done.output
    assert "[3 of 3] hex_nut on gelsight-mini: prepared" in done.output
    assert "1 of 3 objects are not prepared" in done.output


@pytest.mark.slow
def test_several_objects_are_trained_for_each_into_a_folder(tmp_path):
    words = ["train", "--object", "ball,hex_nut", "--architecture", "resnet50", "--pairs", "32", "--side", "32"]
    done = CliRunner().invoke(app, [*words, "--jobs", "1", "--out", str(tmp_path / "weights")])
    assert done.exit_code == 0, done.output
    assert {path.name for path in (tmp_path / "weights").glob("*.safetensors")} == {
        f"{name}.safetensors" for name in PARTS
    }


def test_options_of_training_that_do_not_go_together_are_refused():
    words = ["train", "--object", "ball,hex_nut", "--architecture", "resnet50", "--pairs", "32", "--side", "32"]
    for wrong, said in (
        ([*words, "--out", "one.safetensors"], "--out one.safetensors: expected a folder for the weights of 2 objects"),
        ([*words[:1], "--object", "ball", *words[3:], "--jobs", "2"], "--jobs and --ray train for several objects"),
        (
            ["train", "--object", "ball", *words[3:], "--steps", "64"],
            "--steps does not go with --architecture resnet50",
        ),
        (["train", "--object", "ball", "--architecture", "mask"], "mask: expected encoder or resnet50"),
        (["train", "--object", "ball", "--side", "64"], "--side does not go with --architecture encoder"),
    ):
        refused = CliRunner().invoke(app, wrong)
        assert refused.exit_code == 2 and said in refused.output, refused.output
