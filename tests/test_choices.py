"""Choices: every variant is the default but for what it names, and the figures follow from the records."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from safetensors.numpy import save_file
from typer.testing import CliRunner

from tools.studies.__main__ import app as studies
from tools.studies.choices import study as choices
from tools.studies.choices.plot import draw_ablations, draw_costs
from tools.studies.choices.study import (
    ABLATIONS,
    DEFAULT,
    VARIANTS,
    Timed,
    ablations,
    beaten_by,
    front,
    further_gain,
    summarise,
)

pytestmark = pytest.mark.studies

SMALL = 4000  # poses


def answers_of(gains, ms, mssd=5.0):
    return [Timed(gain, 2.0, 0.5, mssd, 0.4, False, ms) for gain in gains]


# --- variants


def test_a_variant_differs_from_the_default_in_one_setting():
    """An exact contact face leaves so few poses that the grid is smaller; and scores are compared on the grid alone."""
    for name, variant in VARIANTS.items():
        changed = {
            f.name
            for f in fields(variant)
            if f.name not in ("choice", "scenes") and getattr(variant, f.name) != getattr(VARIANTS[DEFAULT], f.name)
        }
        of_two = name.startswith("the grid alone, ") or name.endswith((", the grid alone", ", exact"))
        allowed = ({"effort"} if of_two else set()) | ({"max_poses"} if name.startswith("known face") else set())
        assert len(changed - allowed) == (name != DEFAULT), name
        assert changed or name == DEFAULT
    assert all(a in VARIANTS and b in VARIANTS for a, b in ABLATIONS.values())
    assert all(set(variant.scenes) <= set(choices.SCENES) for variant in VARIANTS.values())


def test_an_ablation_compares_two_variants_of_one_choice():
    """They are prepared alike, or else have the same effort; both are evaluated on some scene, and count from one uniform."""
    for name, (without, with_it) in ABLATIONS.items():
        one, other = VARIANTS[without], VARIANTS[with_it]
        assert one.cone == other.cone and set(one.scenes) & set(other.scenes), name
        assert one.prepared == other.prepared or one.effort == other.effort, name


# --- figures of records made by hand


ANSWERS = {
    DEFAULT: answers_of([2.0, 4.0, 3.0], 40.0),
    "the grid alone": answers_of([1.0, 3.5, 2.0], 10.0),
    "exact": answers_of([2.5, 4.0, 3.1], 100.0),
    "no mode refined": answers_of([1.9, 3.9, 2.9], 50.0),
}


def test_the_pareto_front_holds_the_variants_that_no_other_dominates():
    figures = summarise(ANSWERS)
    assert front(figures) == ["the grid alone", DEFAULT, "exact"]
    assert front(figures, "mssd_mm_median", -1) == ["the grid alone"]
    assert figures[DEFAULT]["gain_mean"] == pytest.approx(3.0)
    assert figures["the grid alone"]["ms_quantiles"] == pytest.approx([10.0] * 3)


def test_only_a_faster_and_significantly_better_variant_beats_the_default():
    figures = summarise(ANSWERS)
    assert beaten_by(ANSWERS, figures) == []
    better = {**ANSWERS, "moments": answers_of([2.5, 4.5, 3.5], 30.0), "iou": answers_of([9.0, 0.0, 0.5], 30.0)}
    assert beaten_by(better, summarise(better)) == ["moments"]


def test_a_variant_that_excludes_truths_or_has_another_uniform_beats_nothing():
    bold = {
        **ANSWERS,
        "moments": answers_of([-np.inf, 9.0, 9.0], 1.0),
        "face to 30 degrees": answers_of([9.0, 9.0, 9.0], 1.0),
    }
    figures = summarise(bold)
    assert beaten_by(bold, figures) == []
    assert not {"moments", "face to 30 degrees"} & set(front(figures))
    assert front(figures, "mssd_mm_median", -1) == ["face to 30 degrees"]
    assert ablations({DEFAULT: answers_of([-np.inf], 1.0), "exact": answers_of([1.0], 1.0)}) == {}


def test_a_truth_that_is_ruled_out_is_counted_apart():
    f = summarise({DEFAULT: answers_of([1.0, -np.inf, 3.0], 1.0)})[DEFAULT]
    assert (f["gain_mean"], f["ruled_out"]) == (2.0, pytest.approx(1 / 3))


def test_an_ablation_reports_the_paired_difference():
    assert further_gain(ANSWERS["the grid alone"], ANSWERS[DEFAULT])[0] == pytest.approx((1 + 0.5 + 1) / 3)
    found = ablations(ANSWERS)
    assert set(found) == {"contacts within the cells", "4 times more, and 25 modes", "modes refined"}
    assert found["contacts within the cells"]["time_ratio"] == pytest.approx(4)
    low, high = found["contacts within the cells"]["gain"][1:]
    assert 0.5 <= low <= 0.9 <= high <= 1.0


# --- the study


@pytest.fixture
def few_variants(monkeypatch, few_touches):
    names = (DEFAULT, "the grid alone", "no mode refined", "symmetry ignored", "depth map", "known face")
    few = {name: replace(VARIANTS[name], max_poses=SMALL) for name in names}
    monkeypatch.setattr(choices, "VARIANTS", few)


def test_the_study_evaluates_every_variant_on_the_same_touches_and_resumes(few_variants, tmp_path, monkeypatch):
    out = tmp_path / "choices.json"
    command = ["choices", "hex_nut", "--touches", "2", "--out", str(out)]
    pictures = ["--plot", str(tmp_path / "a.png"), "--plot-ablations", str(tmp_path / "b.png")]
    shown = CliRunner().invoke(studies, [*command, *pictures])
    assert shown.exit_code == 0, shown.output
    content = json.loads(out.read_text("utf-8"))
    entry = content["parts"]["hex_nut"]
    assert {kind: [len(each) for each in scene["answers"]] for kind, scene in entry["scenes"].items()} == {
        "one touch": [5, 5],
        "three sensors": [3, 3],
        "known contact face": [2, 2],
    }
    assert all(variant["prepare_s"] > 0 for variant in entry["variants"].values())
    assert entry["variants"]["symmetry ignored"]["poses"] > 0
    assert (tmp_path / "a.png").read_bytes() == draw_costs(content)
    assert (tmp_path / "b.png").read_bytes() == draw_ablations(content)
    monkeypatch.setattr(choices, "prepare", None)  # a study that is done prepares nothing
    assert CliRunner().invoke(studies, command).exit_code == 0
    assert json.loads(out.read_text("utf-8"))["parts"] == content["parts"]


def test_own_network_weights_are_further_variants(tmp_path):
    """An encoder of another size has the default's grid, the thesis's network one like its own."""
    from geomtact.scoring.encoder import WEIGHTS

    small, resnet = tmp_path / "small.safetensors", tmp_path / "resnet.safetensors"
    small.write_bytes(WEIGHTS.read_bytes())
    save_file({"x": np.zeros(1, np.float32)}, resnet, {"architecture": "resnet50"})
    variants = choices.variants_of([small, resnet])
    assert set(variants) - set(VARIANTS) == {"the grid alone, encoder small", "the thesis's network"}
    assert variants["the grid alone, encoder small"] == replace(variants["the grid alone, moments"], scorer=str(small))
    assert variants["the thesis's network"].max_poses == 150_000


def test_a_few_variants_are_evaluated_where_they_differ():
    variants = choices.variants_of([], ["known face, exact", "known face"])
    assert list(variants) == [DEFAULT, "known face", "known face, exact"]
    assert choices.scenes_of(variants) == ["known contact face"]
    everywhere = choices.scenes_of(choices.variants_of([]))
    assert everywhere == list(choices.SCENES) == choices.scenes_of({DEFAULT: VARIANTS[DEFAULT]})
    refused = CliRunner().invoke(studies, ["choices", "hex_nut", "--variant", "one mode"])
    assert refused.exit_code == 2 and "no variant named 'one mode'" in refused.output
