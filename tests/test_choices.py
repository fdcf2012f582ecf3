"""Choices: every variant is the default but for what it names, and the figures follow from the records."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from safetensors.numpy import save_file
from typer.testing import CliRunner

from tools.studies.__main__ import app as studies
from tools.studies.choices import study as choices
from tools.studies.choices.plot import draw_costs, draw_modelled
from tools.studies.choices.study import DEFAULT, MODELLED, WAYS, Timed, adds, beaten_by, front, modelled, summarise

pytestmark = pytest.mark.studies

SMALL = 4000  # poses


def answers_of(gains, ms, mssd=5.0):
    return [Timed(gain, 2.0, 0.5, mssd, 0.4, False, ms) for gain in gains]


# --- variants


def test_a_variant_differs_from_the_default_in_one_setting():
    """An exact contact face leaves so few poses that the grid is smaller."""
    for name, way in WAYS.items():
        changed = {
            f.name
            for f in fields(way)
            if f.name not in ("choice", "scenes") and getattr(way, f.name) != getattr(WAYS[DEFAULT], f.name)
        }
        more = {DEFAULT: 0, "this side alone": 2, "this side, 1 mode": 3, "this side, exact": 3}
        assert len(changed) == more.get(name, 1), name
    assert all(a in WAYS and b in WAYS for a, b in MODELLED.values())
    assert all(set(way.scenes) <= set(choices.SCENES) for way in WAYS.values())


# --- figures of records made by hand


ANSWERS = {
    DEFAULT: answers_of([2.0, 4.0, 3.0], 40.0),
    "fast": answers_of([1.0, 3.5, 2.0], 10.0),
    "exact": answers_of([2.5, 4.0, 3.1], 100.0),
    "1 mode": answers_of([1.9, 3.9, 2.9], 50.0),
}


def test_the_pareto_front_holds_the_variants_that_no_other_dominates():
    figures = summarise(ANSWERS)
    assert front(figures) == ["fast", DEFAULT, "exact"]
    assert front(figures, "mssd_mm_median", -1) == ["fast"]
    assert figures[DEFAULT]["gain_mean"] == pytest.approx(3.0)
    assert figures["fast"]["ms_quantiles"] == pytest.approx([10.0] * 3)


def test_only_a_faster_and_significantly_better_variant_beats_the_default():
    figures = summarise(ANSWERS)
    assert beaten_by(ANSWERS, figures) == []
    better = {**ANSWERS, "moments": answers_of([2.5, 4.5, 3.5], 30.0), "iou": answers_of([9.0, 0.0, 0.5], 30.0)}
    assert beaten_by(better, summarise(better)) == ["moments"]


def test_a_variant_that_excludes_truths_or_has_another_uniform_beats_nothing():
    bold = {
        **ANSWERS,
        "moments": answers_of([-np.inf, 9.0, 9.0], 1.0),
        "within 30 degrees": answers_of([9.0, 9.0, 9.0], 1.0),
    }
    figures = summarise(bold)
    assert beaten_by(bold, figures) == []
    assert not {"moments", "within 30 degrees"} & set(front(figures))
    assert front(figures, "mssd_mm_median", -1) == ["within 30 degrees"]
    assert modelled({DEFAULT: answers_of([-np.inf], 1.0), "exact": answers_of([1.0], 1.0)}) == {}


def test_a_truth_that_is_ruled_out_is_counted_apart():
    f = summarise({DEFAULT: answers_of([1.0, -np.inf, 3.0], 1.0)})[DEFAULT]
    assert (f["gain_mean"], f["ruled_out"]) == (2.0, pytest.approx(1 / 3))


def test_an_ablation_reports_the_paired_difference():
    assert adds(ANSWERS["fast"], ANSWERS[DEFAULT])[0] == pytest.approx((1 + 0.5 + 1) / 3)
    found = modelled(ANSWERS)
    assert set(found) == {"balanced, not fast", "640,000 contacts and 25 modes (exact)", "5 modes refined"}
    assert found["640,000 contacts and 25 modes (exact)"]["time_ratio"] == pytest.approx(2.5)
    low, high = found["balanced, not fast"]["adds"][1:]
    assert 0.5 <= low <= 0.9 <= high <= 1.0


# --- the study


@pytest.fixture
def few_ways(monkeypatch, few_touches):
    names = (DEFAULT, "no mode refined", "symmetry ignored", "calibrated on rigid gels", "this side alone")
    monkeypatch.setattr(choices, "WAYS", {name: replace(WAYS[name], max_poses=SMALL) for name in names})
    monkeypatch.setattr(choices, "TOUCHES", 60)


def test_the_study_evaluates_every_variant_on_the_same_touches_and_resumes(few_ways, tmp_path, monkeypatch):
    out = tmp_path / "choices.json"
    command = ["choices", "hex_nut", "--touches", "2", "--out", str(out)]
    pictures = ["--plot", str(tmp_path / "a.png"), "--plot-modelled", str(tmp_path / "b.png")]
    shown = CliRunner().invoke(studies, [*command, *pictures])
    assert shown.exit_code == 0, shown.output
    content = json.loads(out.read_text("utf-8"))
    entry = content["parts"]["hex_nut"]
    assert {kind: [len(each) for each in scene["answers"]] for kind, scene in entry["scenes"].items()} == {
        "one touch": [4, 4],
        "three sensors": [2, 2],
        "known side": [2, 2],
    }
    assert all(way["prepare_s"] > 0 for way in entry["ways"].values())
    assert entry["ways"]["symmetry ignored"]["poses"] > 0
    assert (tmp_path / "a.png").read_bytes() == draw_costs(content)
    assert (tmp_path / "b.png").read_bytes() == draw_modelled(content)
    monkeypatch.setattr(choices, "prepare", None)  # a study that is done prepares nothing
    assert CliRunner().invoke(studies, command).exit_code == 0
    assert json.loads(out.read_text("utf-8"))["parts"] == content["parts"]


def test_own_network_weights_are_further_variants(tmp_path):
    """An encoder of another size has the default's grid, the thesis's network one like its own."""
    from geomtact.scoring.encoder import WEIGHTS

    small, resnet = tmp_path / "small.safetensors", tmp_path / "resnet.safetensors"
    small.write_bytes(WEIGHTS.read_bytes())
    save_file({"x": np.zeros(1, np.float32)}, resnet, {"architecture": "resnet50"})
    ways = choices.ways_of([small, resnet])
    assert set(ways) - set(WAYS) == {"encoder small", "the thesis's network"}
    assert ways["encoder small"] == replace(ways["encoder"], choice="encoder", scorer=str(small))
    assert ways["the thesis's network"].max_poses == 150_000
    more = {"encoder": answers_of([1.0, 2.0], 1.0), "encoder small": answers_of([0.5, 1.0], 1.0)}
    assert modelled(more)["encoder small, not encoder"]["adds"][0] == pytest.approx(-0.75)
    assert front(summarise({DEFAULT: answers_of([1.0, 2.0], 1.0), **more}))[0] == DEFAULT


def test_a_few_variants_are_evaluated_where_they_differ():
    ways = choices.ways_of([], ["this side, 1 mode", "this side alone"])
    assert list(ways) == [DEFAULT, "this side alone", "this side, 1 mode"]
    assert choices.scenes_of(ways) == ["known side"]
    assert choices.scenes_of(choices.ways_of([])) == list(choices.SCENES) == choices.scenes_of({DEFAULT: WAYS[DEFAULT]})
    refused = CliRunner().invoke(studies, ["choices", "hex_nut", "--way", "one mode"])
    assert refused.exit_code == 2 and "no variant named 'one mode'" in refused.output
