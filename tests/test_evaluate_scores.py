"""Scores side by side: all see the same touches, the figures follow from the outcomes, and a stopped run goes on."""

import io
import json

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from geomtact import Localizer, load_mesh
from geomtact.evaluation import LEVELS, describe
from geomtact.scoring import catalogue, fitted
from geomtact.scoring.vectors import VectorScorer
from geomtact.sensing.sensor import Sensor
from tools.studies.__main__ import app as studies
from tools.studies.common import study, study_file
from tools.studies.scores import study as scores
from tools.studies.scores.plot import draw_scores

pytestmark = pytest.mark.studies

NAMES = ["l1", "iou", "moments"]
TOUCHES = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("scores")


@pytest.fixture(scope="module")
def evaluate(folder):
    """Runs ``python -m tools.studies scores`` on small grids, with calibrations from few touches; checks the exit status.

    Touches of the same object and kind are made once for all tests.
    """
    made, make = {}, study.make_touches

    def touches_of(scene, *args, **options):
        key = scene.mesh.name, *args, *options.values()
        if key not in made:
            made[key] = make(scene, *args, **options)
        return made[key]

    def run(*words, status=0, touches=TOUCHES):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(fitted, "TOUCHES", 40)
            patch.setattr(study, "make_touches", touches_of)
            patch.setattr(study, "random_add", lambda *_: 5e-3)
            settings = ["--sensor", "gelsight-mini", "--touches", touches, "--max-poses", 3000, "--seed", 7]
            args = ["scores", *words, *settings, "--cache-dir", folder / "cache"]
            done = CliRunner().invoke(studies, [str(a) for a in args])
            assert done.exit_code == status, done.output
            return done

    return run


@pytest.fixture(scope="module")
def whole(evaluate, folder):
    """A study of three scores on two objects: its file's content, what was printed, and its picture."""
    out, plot = folder / "whole.json", folder / "whole.png"
    done = evaluate("ball", "hex_nut", "--scores", *NAMES, "--out", out, "--plot", plot)
    return json.loads(out.read_text()), done.stdout, plot


def outcomes(content, object_name, name):
    return study_file.outcomes(content["parts"][object_name]["scores"][name], scores.Scored)


def test_the_file_records_every_input_of_its_figures(whole, folder):
    content, _, _ = whole
    assert content["schema"] == "geomtact/scores/2" and content["versions"]["numpy"] == np.__version__
    settings = content["settings"]
    assert settings["noise"]["name"] == "moderate" and settings["noise"]["specks"] == 2
    assert [settings[k] for k in ("seed", "touches", "felt", "effort", "max_poses")] == [
        7,
        6,
        "elastic",
        "balanced",
        3000,
    ]
    assert list(content["parts"]) == ["ball", "hex_nut"]
    for object_name, found in content["parts"].items():
        assert found["object_sha256"] == load_mesh(object_name).sha256
        assert list(found["scores"]) == NAMES
        for name, entry in found["scores"].items():
            localizer = Localizer.prepare(
                object_name, sensor="gelsight-mini", scorer=name, max_poses=3000, cache_dir=folder / "cache"
            )
            assert entry["settings"] == json.loads(json.dumps(describe(localizer)))
            assert entry["settings"]["index"] == localizer.index.key and entry["settings"]["calibration"]["temperature"]
            assert entry["bytes_per_pose"] == pytest.approx(
                24 if name == "moments" else np.prod(localizer.index.resolution.mask_shape) / 8 + 2
            )
            assert all(seconds >= 0 for seconds in entry["prepare_s"].values()), "measured where nothing was cached"
            assert set(entry["prepare_s"]) == {"index", "describe", "calibrate"}
            figures = entry["figures"]["all"]
            assert figures["n"] == len(entry["outcomes"]) == TOUCHES and len(figures["coverage"]) == 4
            assert 0 < figures["score_ms_median"] < figures["ms_median"]


def test_all_scores_are_evaluated_on_the_same_elastic_touches(whole):
    content, _, _ = whole
    for object_name in content["parts"]:
        depths = [[o.penetration_mm for o in outcomes(content, object_name, name)] for name in NAMES]
        assert depths[0] == depths[1] == depths[2]
        assert all(o.elastic for name in NAMES for o in outcomes(content, object_name, name))


def test_a_score_is_compared_with_iou_touch_by_touch(whole):
    content, _, _ = whole
    for object_name, found in content["parts"].items():
        gain = {name: np.array([o.gain for o in outcomes(content, object_name, name)]) for name in NAMES}
        for name, entry in found["scores"].items():
            figures, difference = entry["figures"]["all"], gain[name] - gain["iou"]
            assert figures["over_iou_mean"] == pytest.approx(difference.mean(), abs=1e-12)
            error = difference.std(ddof=1) / np.sqrt(TOUCHES)
            assert figures["over_iou_standard_error"] == pytest.approx(error, abs=1e-12)
            assert entry["figures"]["elastic"]["gain_mean"] == figures["gain_mean"] == pytest.approx(gain[name].mean())


def test_over_all_objects_means_are_of_objects_and_coverage_is_of_touches(whole):
    content, _, _ = whole
    assert list(content["overall"]) == NAMES
    for name, entry in content["overall"].items():
        together = entry["figures"]["all"]
        each = [entry["scores"][name] for entry in content["parts"].values()]
        for key in ("gain_mean", "over_iou_mean", "mssd_mm_median", "mssd10_mm_median", "score_ms_median"):
            assert together[key] == pytest.approx(np.mean([e["figures"]["all"][key] for e in each]))
        errors = [e["figures"]["all"]["gain_standard_error"] for e in each]
        assert together["gain_standard_error"] == pytest.approx(np.sqrt(np.square(errors).sum()) / 2)
        level = [o.level for object_name in content["parts"] for o in outcomes(content, object_name, name)]
        assert together["n"] == len(level) == 2 * TOUCHES
        assert [c["share"] for c in together["coverage"]] == [np.mean(np.array(level) <= m) for m in LEVELS]
        assert entry["prepare_s"]["index"] == np.mean([e["prepare_s"]["index"] for e in each])


def test_the_screen_shows_a_table_for_each_object_and_one_over_all(whole):
    content, printed, _ = whole
    titles = ["ball: 6 touches on gelsight-mini", "hex_nut: 6 touches on gelsight-mini", "mean over ball, hex_nut"]
    tables = [printed.index(title) for title in titles]
    assert tables == sorted(tables)
    gain = content["overall"]["moments"]["figures"]["all"]["gain_mean"]
    row = next(line for line in printed[tables[2] :].splitlines() if line.startswith(" moments"))
    assert f"{gain:.2f} ±" in row
    assert max(map(len, printed.splitlines())) <= 160


@pytest.fixture
def stopped(whole, tmp_path):
    """The file as it is after a kill: the last object's second score has four of its touches, and the third none."""
    content = json.loads(json.dumps(whole[0]))
    del content["overall"]
    found = content["parts"]["hex_nut"]["scores"]
    del found["moments"], found["iou"]["figures"]
    del found["iou"]["outcomes"][4:]
    out = tmp_path / "stopped.json"
    out.write_text(json.dumps(content))
    return out


def test_a_stopped_study_goes_on_and_ends_as_the_whole_one(whole, stopped, evaluate, monkeypatch):
    asked, before = [], {}
    for object_name in whole[0]["parts"]:
        for name in NAMES:
            before[object_name, name] = outcomes(whole[0], object_name, name)

    def judged(localizer, touches, effort, seed):
        asked.append((localizer.mesh.name, localizer.scorer.name, len(touches)))
        return iter(before[asked[-1][:2]][TOUCHES - len(touches) :])

    monkeypatch.setattr(scores, "judged", judged)
    evaluate("ball", "hex_nut", "--scores", *NAMES, "--out", stopped)
    assert [a for a in asked if a[2]] == [("hex_nut", "iou", 2), ("hex_nut", "moments", TOUCHES)]
    content = json.loads(stopped.read_text())
    assert content["parts"]["ball"] == whole[0]["parts"]["ball"]
    for name in NAMES:
        here, there = (c["parts"]["hex_nut"]["scores"][name] for c in (content, whole[0]))
        assert here["figures"] == there["figures"] and here["outcomes"] == there["outcomes"]
        assert content["overall"][name]["figures"] == whole[0]["overall"][name]["figures"]
    # what the cache holds is not timed again, and the third score's time went with its entry
    assert content["parts"]["hex_nut"]["scores"]["iou"]["prepare_s"]["calibrate"] is not None
    assert content["parts"]["hex_nut"]["scores"]["moments"]["prepare_s"]["calibrate"] is None


def test_a_killed_run_keeps_its_results(whole, evaluate, tmp_path, monkeypatch):
    """The outcomes of the killed run and of the one that goes on are those of a run in one piece."""
    monkeypatch.setattr(study_file, "_SAVE_EVERY", 2)
    whole_run = scores.judged

    def killed(*args):
        for k, outcome in enumerate(whole_run(*args)):
            if k == 3:
                raise KeyboardInterrupt
            yield outcome

    out = tmp_path / "killed.json"
    with monkeypatch.context() as patch:
        patch.setattr(scores, "judged", killed)
        evaluate("ball", "--scores", "iou", "--out", out, status=130)
    assert len(json.loads(out.read_text())["parts"]["ball"]["scores"]["iou"]["outcomes"]) == 2
    evaluate("ball", "--scores", "iou", "--out", out)
    here, there = (outcomes(content, "ball", "iou") for content in (json.loads(out.read_text()), whole[0]))
    assert [(o.gain, o.level, o.mssd_mm) for o in here] == [(o.gain, o.level, o.mssd_mm) for o in there]


def test_a_score_may_be_added_later_and_is_compared_with_iou_from_the_file(evaluate, tmp_path):
    out = tmp_path / "scores.json"
    evaluate("ball", "--scores", "iou", "--out", out)
    evaluate("ball", "--scores", "l1", "--out", out)
    found = json.loads(out.read_text())["parts"]["ball"]["scores"]
    assert list(found) == ["iou", "l1"]
    assert found["l1"]["figures"]["all"]["over_iou_mean"] is not None


def test_touches_of_both_kinds_are_reported_apart(evaluate, tmp_path):
    out = tmp_path / "both.json"
    printed = evaluate("ball", "--scores", "l1", "--felt", "both", "--out", out).stdout
    entry = json.loads(out.read_text())["parts"]["ball"]["scores"]["l1"]
    assert {name: f["n"] for name, f in entry["figures"].items()} == {"all": 6, "geometric": 3, "elastic": 3}
    assert entry["figures"]["all"]["over_iou_mean"] is None, "iou was not judged"
    assert "geometric" in printed and "elastic" in printed


def test_other_settings_leave_the_file_as_it_is(whole, evaluate, folder):
    out = folder / "whole.json"
    before = out.read_text()
    printed = evaluate("ball", "--scores", "iou", "--out", out, touches=7, status=3).stderr
    assert "other settings (touches)" in printed and printed.count("\n") == 1
    assert out.read_text() == before
    other = folder / "other_part.json"
    held = json.loads(before)
    held["parts"]["ball"]["object_sha256"] = "0" * 64
    other.write_text(json.dumps(held))
    printed = evaluate("ball", "--scores", "iou", "--out", other, status=3).stderr
    assert "a study of ball with other settings (object_sha256)" in printed and printed.count("\n") == 1
    assert json.loads(other.read_text()) == held


def test_unknown_words_are_named(evaluate):
    printed = evaluate("ball", "--scores", "momens", status=2).stderr
    assert "no score named 'momens'; did you mean 'moments'?" in printed
    printed = evaluate("ball", "--scores", "l1", "iuo", status=2).stderr
    assert "no score or part named 'iuo'; did you mean 'iou'?" in printed
    done = CliRunner().invoke(studies, ["localize", "ball", "--scores", "iou"])
    assert done.exit_code == 2 and "No such option: --scores" in done.stderr
    done = CliRunner().invoke(studies, ["localize"])
    assert done.exit_code == 2 and "Missing argument 'OBJECT...'" in done.stderr


def test_by_default_all_scores_are_evaluated_on_the_thesis_objects():
    from tools.studies.scores.command import sort_words

    names = [*catalogue.SCORERS, "fast", "balanced", "exact"]
    assert sort_words([], []) == (["pin", "damping_pin", "head", "elbow_pipe"], names)
    assert sort_words([], ["mine.safetensors"])[1] == ["mine.safetensors"]
    assert sort_words(["iou", "head"], ["l1"]) == (["head"], ["l1", "iou"])


def test_a_step_is_timed_by_itself_and_one_from_the_cache_is_not(monkeypatch):
    now = iter([0.0, 2.0, 5.0, 9.0])
    monkeypatch.setattr(scores.time, "perf_counter", lambda: next(now))
    heard = []

    def work(report):
        report(0.5, "half")
        return "made"

    assert scores.timed(work, lambda done, doing: heard.append((done, doing))) == ("made", 2.0)
    assert heard == [(0.5, "half")]
    assert scores.timed(lambda report: "read") == ("read", None)


def test_cached_results_are_not_timed(whole, folder):
    mesh, sensor = load_mesh("ball"), Sensor.load("gelsight-mini")
    _, times = scores.prepare(mesh, sensor, "iou", 3000, folder / "cache")
    assert times == scores.PrepareTimes(index=None, describe=0.0, calibrate=None)


def test_a_score_that_compares_vectors_is_timed_step_by_step(evaluate, tmp_path, monkeypatch):
    monkeypatch.setattr(fitted, "TOUCHES", 40)
    mesh, sensor = load_mesh("ball"), Sensor.load("gelsight-mini")
    first, again = (scores.prepare(mesh, sensor, "encoder", 3000, tmp_path)[1] for _ in range(2))
    assert min(first.index, first.describe, first.calibrate) > 0
    assert again == scores.PrepareTimes(None, None, None)


def test_the_picture_is_drawn_from_the_file_alone(whole):
    content, _, plot = whole
    picture = draw_scores(content)
    assert picture == plot.read_bytes(), "the same file gives the same picture"
    shown = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))
    assert min(shown.shape[:2]) > 300 and shown.std() > 5
    # one object alone, and a file that a kill left without any figures, are drawn as well
    one = {**content, "parts": {"ball": content["parts"]["ball"]}}
    assert np.asarray(Image.open(io.BytesIO(draw_scores(one)))).shape[1] < shown.shape[1]
    bare = {"settings": content["settings"], "parts": {"ball": {"scores": {"l1": {}}}}}
    assert draw_scores(bare).startswith(b"\x89PNG")


def test_the_memory_of_vectors_is_their_bytes(folder, whole):
    localizer = Localizer.prepare(
        "ball", sensor="gelsight-mini", scorer="l1", max_poses=3000, cache_dir=folder / "cache"
    )
    vectors = VectorScorer(None, np.zeros((len(localizer.index), 7), np.float16))
    assert scores.bytes_per_pose(vectors, localizer.index) == 14
