"""``geomtact evaluate``: an exact posterior is calibrated, runs repeat and continue, and figures follow from the outcomes."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from geomtact import Localizer
from geomtact.cli import app
from geomtact.evaluation import LEVELS, Outcome, accuracy, assess, changed, coverage, simultaneous_touches
from geomtact.geometry.distance import PoseDistance

TOUCHES = 2


@pytest.fixture(scope="module")
def evaluate(plug, cache_dir):
    """Runs ``geomtact evaluate connector_plug`` on the index of ``plug``; checks the exit status."""

    def run(*words, objects=("connector_plug",), status=0):
        fixed = ["--sensor", "gelslim", "--max-poses", 20_000, "--cache-dir", cache_dir, "--effort", "fast"]
        args = ["evaluate", *objects, "--touches", TOUCHES, "--sensors", "1,2", *fixed, *words]
        done = CliRunner().invoke(app, [str(a) for a in args])
        assert done.exit_code == status, (done.output, done.exception)
        if status:
            assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1 and not done.stdout
        return done

    return run


@pytest.fixture(scope="module")
def whole(evaluate, tmp_path_factory):
    """A finished evaluation: the folder, the file's content, and what was printed."""
    out = tmp_path_factory.mktemp("evaluation")
    printed = evaluate("--out", out).stdout
    return out, json.loads((out / "connector_plug.json").read_text()), printed


def timeless(content):
    """A copy without times, which no two runs share."""
    content = json.loads(json.dumps(content))
    for each in [*content["figures"], *(outcome for row in content["outcomes"] for outcome in row)]:
        for key in [key for key in each if key.startswith("ms")]:
            del each[key]
    return content


def test_an_exact_posterior_covers_its_own_draws_and_gains_what_it_expects(plug, a_touch):
    """A pose drawn from the posterior is a true pose for which that posterior is exact."""
    posterior = plug.localize(a_touch(plug)[1], "mask", effort="fast")
    distance = PoseDistance(plug.mesh)
    found = [assess(posterior, T, 1, distance) for T in posterior.sample(120, np.random.default_rng(0))]
    for each in coverage([each.level for each in found], LEVELS, 0.999):
        assert each.low <= each.nominal <= each.high
    gain = np.array([each.gain for each in found])
    assert {each.expected_gain for each in found} == {posterior.information_gain_nats}
    assert abs(gain.mean() - found[0].expected_gain) < 4 * gain.std() / np.sqrt(len(gain))


def test_touches_are_of_one_object_and_repeat(plug):
    first, again = (list(simultaneous_touches(plug.space, 2, 3, 5)) for _ in range(2))
    assert [t.elastic for scene in first for t in scene.touches] == [False, True] * 3
    for scene, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(scene.T_world_object, other.T_world_object)
        for T_world_sensor, touch in zip(scene.T_world_sensor, scene.touches, strict=True):
            np.testing.assert_allclose(T_world_sensor @ touch.T_sensor_object, scene.T_world_object, atol=1e-12)
            assert plug.space.penetration(touch.T_sensor_object[None])[0] == pytest.approx(touch.penetration, abs=1e-6)


def test_the_file_holds_outcomes_settings_and_versions(whole, plug):
    _, content, _ = whole
    assert content["schema"] == "geomtact/evaluation/1" and content["versions"]["numpy"] == np.__version__
    assert content["object"] == {"name": "connector_plug", "sha256": plug.mesh.sha256, "unit": plug.mesh.unit}
    settings = content["settings"]
    assert (settings["touches"], settings["sensors"], settings["effort"], settings["seed"]) == (
        TOUCHES,
        [1, 2],
        "fast",
        1,
    )
    assert settings["noise"]["name"] == "moderate" and settings["index"] == plug.index.key
    assert [[outcome["sensors"] for outcome in row] for row in content["outcomes"]] == [[1, 2]] * TOUCHES
    rows = [[Outcome(**outcome) for outcome in row] for row in content["outcomes"]]
    for figures, found in zip(content["figures"], accuracy(rows), strict=True):
        assert figures["information_gain_nats"] == found.information_gain_nats
        assert figures["error_mm_median"] == found.error_mm_median >= found.best_of_5_error_mm_median
        assert [c["nominal"] for c in figures["coverage"]] == list(LEVELS)


def test_an_outcome_is_what_the_posterior_says_of_the_true_pose(whole, plug):
    _, content, _ = whole
    scene = next(iter(simultaneous_touches(plug.space, TOUCHES, 3, 1)))
    images = [touch.mask for touch in scene.touches[:2]]
    posterior = plug.localize(images, "mask", None, scene.T_world_sensor[:2], effort="fast", seed=1)
    outcome = content["outcomes"][0][1]
    assert outcome["information_gain_nats"] == posterior.log_density(scene.T_world_object)
    assert outcome["credible_level"] == posterior.credible_level(scene.T_world_object)
    assert outcome["expected_information_gain_nats"] == posterior.information_gain_nats


def test_the_screen_and_the_picture_show_the_figures(whole):
    out, content, printed = whole
    assert f"{TOUCHES} simulated touches by each number of sensors" in printed
    for figures in content["figures"]:
        assert f"{figures['information_gain_nats']:.2f} ± {figures['standard_error_nats']:.2f}" in printed
    errors = [f"{figures['error_mm_median']:.1f} mm off" for figures in content["figures"]]
    assert f"{errors[0]} with 1 sensor and {errors[1]} with 2 sensors" in printed
    with Image.open(out / "connector_plug.png") as picture:
        assert min(picture.size) > 500


def test_the_same_seed_gives_the_same_result_and_another_seed_another(whole, evaluate):
    _, content, _ = whole
    assert timeless(json.loads(evaluate("--json").stdout)) == timeless(content)
    other = json.loads(evaluate("--json", "--seed", 2, "--touches", 1, "--sensors", 1).stdout)
    gains = [each["outcomes"][0][0]["information_gain_nats"] for each in (content, other)]
    assert gains[0] != gains[1]


def test_a_stopped_evaluation_keeps_what_it_has_and_continues_to_the_same_file(whole, evaluate, tmp_path, monkeypatch):
    calls, localize = [], Localizer.localize

    def stop_at_the_fourth(self, *args, **options):
        calls.append(args)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return localize(self, *args, **options)

    monkeypatch.setattr(Localizer, "localize", stop_at_the_fourth)
    with pytest.raises(AssertionError):  # any exit status but 0
        evaluate("--out", tmp_path)
    held = json.loads((tmp_path / "connector_plug.json").read_text())
    assert len(held["outcomes"]) == 1, "one row of two localizations was whole"
    evaluate("--out", tmp_path)
    assert len(calls) == 4 + 2 * (TOUCHES - 1)
    assert timeless(json.loads((tmp_path / "connector_plug.json").read_text())) == timeless(whole[1])
    monkeypatch.setattr(Localizer, "localize", None)
    evaluate("--out", tmp_path)  # a finished one is not made again


def test_several_objects_are_evaluated_apart(whole, evaluate, tmp_path):
    printed = evaluate("--jobs", 1, "--out", tmp_path, "--json").stdout
    assert timeless(json.loads(printed)) == timeless(whole[1])


def test_what_cannot_be_done_is_one_line(evaluate, whole, tmp_path):
    out, content, _ = whole
    assert "--sensors: expected whole numbers above 0" in evaluate("--sensors", "1,0", status=2).stderr
    assert "--sensors: expected whole numbers above 0" in evaluate("--sensors", "two", status=2).stderr
    assert "need --out" in evaluate(objects=("connector_plug", "ball"), status=2).stderr
    assert "two objects are named 'ball'" in evaluate("--out", tmp_path, objects=("ball", "ball"), status=2).stderr
    assert "no effort named 'fsat'" in evaluate("--effort", "fsat", status=2).stderr
    assert "other settings (seed)" in evaluate("--out", out, "--seed", 2, status=3).stderr
    assert json.loads((out / "connector_plug.json").read_text()) == content
    (tmp_path / "connector_plug.json").write_text("{}")
    assert "geomtact/evaluation/1" in evaluate("--out", tmp_path, status=3).stderr
    assert (tmp_path / "connector_plug.json").read_text() == "{}"


def test_figures_without_any_pose_that_agrees():
    lost = Outcome(2, -math.inf, 0.0, 1.0, math.inf, math.inf, False, 0.0)
    right = replace(lost, information_gain_nats=3.0, credible_level=0.2, error_mm=1.0, best_of_5_error_mm=1.0)
    (figures,) = accuracy([[lost], [right], [right]])
    assert (figures.n, figures.information_gain_nats, figures.excluded) == (3, 3.0, pytest.approx(1 / 3))
    assert (figures.error_mm_median, figures.error_mm_90_percent) == (1.0, math.inf)
    assert accuracy([[lost]])[0].information_gain_nats is None


@pytest.mark.parametrize(("off", "names"), [(1e-7, []), (1e-3, ["calibration"])])
def test_another_processor_changes_no_setting(off, names):
    """Its arithmetic differs in the last digits."""
    held = {"object": "ball", "calibration": {"temperature": 0.95}, "levels": [0.1, 0.2], "touches": 6}
    assert changed(held, held | {"calibration": {"temperature": 0.95 * (1 + off)}}) == names
