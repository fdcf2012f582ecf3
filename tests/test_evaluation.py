"""Evaluation: pose errors obey their definitions, coverage its binomial law, and a study repeats, resumes and adds up."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from geomtact import Localizer, Mesh, load_mesh
from geomtact.errors import InputError
from geomtact.evaluation import LEVELS, coverage
from geomtact.geometry.distance import PoseDistance, mode_radius, mssd
from geomtact.inference.effort import EFFORTS
from geomtact.se3 import exp, log, random_rotations, transform
from geomtact.sensing.noise import CLEAN, MODERATE
from tools.studies.__main__ import app as studies
from tools.studies.common import study, study_file
from tools.studies.common.pictures import draw
from tools.studies.common.pose_error import add, add_s
from tools.studies.common.study import random_add
from tools.studies.localize import study as proper
from tools.studies.thesis import known_approach

pytestmark = pytest.mark.studies

MM = 1e-3
ROOT = Path(__file__).parents[1]


def random_poses(n, rng, spread=20 * MM):
    return transform(random_rotations(n, rng), rng.normal(0, spread, (n, 3)))


@pytest.fixture(scope="module")
def nut():
    return load_mesh("hex_nut").with_symmetry()


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def localizer(cache, few_touches):
    return Localizer.prepare("ball", sensor="gelsight-mini", cache_dir=cache)


def test_a_shift_moves_every_point_as_far(nut, rng):
    points = nut.surface_points(200)
    (T,) = random_poses(1, rng)
    for shift in rng.normal(0, 5 * MM, (5, 3)):
        moved = T.copy()
        moved[:3, 3] += shift
        far = np.linalg.norm(shift)
        assert add(T, moved, points)[0] == pytest.approx(far)
        assert 0 < add_s(T, moved, points)[0] <= far
        assert far * (1 - 1e-9) <= mssd(T, moved, load_mesh("bracket"))[0] <= far * (1 + 1e-9)


def test_mssd_of_a_turn_is_the_chord_of_the_farthest_corner(rng):
    """For a brick without symmetry but the identity the group is given in closed form."""
    brick = trimesh.creation.box((20 * MM, 30 * MM, 50 * MM))
    mesh = Mesh(brick.vertices, brick.faces, "brick", "m")
    for angle in (0.1, 1.0, 3.0):
        turn = exp(np.array([0, 0, angle, 0, 0, 0]))
        (T,) = random_poses(1, rng)
        chord = 2 * np.hypot(10 * MM, 15 * MM) * np.sin(angle / 2)
        assert mssd(T, T @ turn, mesh)[0] == pytest.approx(chord)


def test_errors_bound_one_another(nut, rng):
    """ADD-S <= ADD; ADD modulo symmetry <= ADD, at the image nearest in mean square; no point moves further than MSSD."""
    points, distance = nut.surface_points(256), PoseDistance(nut)
    T, others = random_poses(1, rng)[0], random_poses(30, rng)
    plain, modulo, largest = add(T, others, points), distance.mean(T, others), mssd(T, others, nut)
    assert (add_s(T, others, points) <= plain + 1e-12).all()
    assert (modulo <= 1.02 * plain).all()
    assert (modulo <= largest).all()
    assert (largest <= 1e-6 + np.linalg.norm(others[:, :3, 3] - T[:3, 3], axis=1) + nut.diameter).all()


def test_mssd_and_add_do_not_see_the_symmetry(nut, rng):
    T, T_true = random_poses(1, rng)[0], random_poses(1, rng)[0]
    images = T @ nut.symmetry.elements
    assert len(images) == 12
    assert np.ptp(mssd(T_true, images, nut)) < 1e-9
    assert np.ptp(PoseDistance(nut).mean(T_true, images)) < 1e-9
    assert mssd(T, images, nut).max() < 1e-9
    assert add(T, images, nut.surface_points(100)).max() > 1 * MM


def test_mssd_of_a_ball_is_the_distance_of_the_centres(rng):
    ball = load_mesh("ball").with_symmetry()
    assert ball.symmetry.kind == "sphere"
    T, others = random_poses(1, rng)[0], random_poses(10, rng)
    apart = np.linalg.norm((others - T)[:, :3, :3] @ ball.centre + (others - T)[:, :3, 3], axis=1)
    np.testing.assert_allclose(mssd(T, others, ball), apart, rtol=1e-9)


def test_expected_error_of_a_random_guess(localizer):
    distance, rng = PoseDistance(localizer.mesh), np.random.default_rng(5)
    expected = random_add(distance, localizer.space, n=150)
    T, _ = localizer.space.sample(150, rng)
    guess, _ = localizer.space.sample(150, rng)
    found = [distance.mean(a, b[None])[0] for a, b in zip(T, guess, strict=True)]
    assert np.mean(found) == pytest.approx(expected, abs=5 * np.std(found) * np.sqrt(2 / 150))


def test_coverage_of_calibrated_levels_and_its_intervals():
    none = coverage(np.ones(10), [0.5])[0]
    assert (none.share, none.low) == (0, 0)
    assert none.high == pytest.approx(1 - 0.025 ** (1 / 10))  # Clopper and Pearson in closed form for no hit
    rng = np.random.default_rng(0)
    hits = [c.low <= c.nominal <= c.high for _ in range(100) for c in coverage(rng.random(60), LEVELS)]
    assert np.mean(hits) >= 0.95  # exact intervals are never too short
    shares = [c.share for c in coverage(rng.random(20_000), LEVELS)]
    np.testing.assert_allclose(shares, LEVELS, atol=0.012)


def test_touches_repeat_and_only_elastic_ones_are_computed_anew(localizer):
    space = localizer.space
    blob = np.zeros(localizer.sensor.image_size_px[::-1], bool)
    blob[100:130, 150:190] = True
    own = study.make_touches(localizer.space, 6, 3, CLEAN)
    again = study.make_touches(localizer.space, 6, 3, CLEAN)
    felt = study.make_touches(localizer.space, 6, 3, CLEAN, lambda s, T, elastic: blob)
    assert [t.elastic for t in own] == [False, True] * 3
    for a, b, c in zip(own, again, felt, strict=True):
        np.testing.assert_array_equal(a.T_sensor_object, c.T_sensor_object)
        np.testing.assert_array_equal(a.mask, b.mask)
        np.testing.assert_array_equal(c.mask, blob if c.elastic else a.mask)
        assert np.isfinite(space.penetration(a.T_sensor_object)).all()


def test_the_energy_score_is_least_for_the_distribution_that_truths_come_from(rng):
    """Of distributions of an object without and with symmetry that are shifted, too narrow or too wide."""
    for name in ("bracket", "hex_nut", "ball"):
        mesh = load_mesh(name).with_symmetry()

        def drawn(n, spread, shift=0.0):
            T = exp(rng.normal(size=(n, 6)) * np.repeat([spread * 0.2, spread * 3 * MM], 3))
            T[:, :3, 3] += shift
            return T

        truths = drawn(60, 1.0)
        others = {
            "true": drawn(400, 1.0),
            "off": drawn(400, 1.0, 4 * MM),
            "bold": drawn(400, 0.3),
            "vague": drawn(400, 3.0),
        }
        score = {kind: np.array([proper.energy_score(some, T, mesh) for T in truths]) for kind, some in others.items()}
        for kind in ("off", "bold", "vague"):
            more = score[kind] - score["true"]
            assert more.mean() > 2 * more.std() / np.sqrt(60), (name, kind)


def test_the_energy_score_of_a_certain_estimate_is_its_error_modulo_symmetry(nut, rng):
    T, other = random_poses(2, rng)
    one = np.repeat(other[None], 10, 0)
    bare = load_mesh("bracket")
    assert proper.energy_score(one, T, bare) == pytest.approx(add(T, other, bare.surface_points(64))[0])
    image = other @ nut.symmetry.elements[1]
    turned = np.repeat(image[None], 10, 0)
    assert proper.energy_score(one, T, nut) == pytest.approx(proper.energy_score(turned, T, nut))


def test_tarp_levels_are_uniform_for_a_calibrated_posterior_and_bunch_for_a_bold_one(nut, rng):
    distance = PoseDistance(nut)

    def levels(spread):
        out = []
        for reference in random_poses(300, rng):
            T, *drawn = exp(rng.normal(size=(101, 6)) * np.repeat([0.3, 5 * MM], 3))
            narrow = exp(spread * np.array([log(one) for one in drawn]))
            out.append(proper.tarp_level(narrow, T, reference, distance))
        return proper.uniformity(out)

    calibrated, bold = levels(1.0), levels(0.3)
    assert calibrated["p"] > 0.01 and sum(calibrated["counts"]) == 300
    assert bold["p"] < 1e-6 and bold["counts"][0] + bold["counts"][-1] > 150


def test_modes_right_as_often_as_their_probability_are_reliable(rng):
    claimed = rng.random(4000)
    found = study.reliability(claimed, rng.random(4000) < claimed)
    assert sum(b["n"] for b in found) == 4000
    assert sum(b["low"] <= b["claimed"] <= b["high"] for b in found) >= len(found) - 1
    (bold,) = study.reliability(np.full(50, 0.8), np.zeros(50))
    assert bold["share"] == 0 and bold["high"] < bold["claimed"]


def test_a_study_reports_the_figures_of_the_posterior(localizer):
    touches = study.make_touches(localizer.space, 8, 1, MODERATE)
    outcomes = list(proper.judge(localizer, touches, "fast", 1))
    for touch, outcome in zip(touches, outcomes, strict=True):
        posterior = localizer.localize(touch.mask, kind="mask", effort="fast", seed=1)
        assert outcome.gain == posterior.log_density(touch.T_sensor_object)
        assert outcome.level == posterior.credible_level(touch.T_sensor_object)
        assert outcome.claimed == -posterior.entropy_nats
        off = np.linalg.norm((posterior.modes(1)[0].T - touch.T_sensor_object)[:3, 3]) / MM
        assert outcome.mssd_mm == pytest.approx(off) == outcome.add_mm  # of a ball about its origin
        assert outcome.mssd10_mm <= outcome.mssd_mm
    figures = study.summarise(outcomes, 5.0)
    assert [figures[g]["n"] for g in ("all", "geometric", "elastic")] == [8, 4, 4]
    whole = proper.summarise(outcomes, 5.0)["all"]
    assert whole["recall"]["1"][0] == np.mean([o.mssd_mm <= 10 for o in outcomes])
    assert sum(whole["levels"]["counts"]) == sum(whole["tarp"]["counts"]) == 8
    # of a ball's centre alone, which one touch fixes to a millimetre or two
    assert all(-0.2 < o.energy_mm <= o.mssd_mm + 3 for o in outcomes)
    assert [o.held for o in outcomes] == [o.add_mm <= 1e3 * mode_radius(localizer.mesh) for o in outcomes]
    gain = [o.gain for o in outcomes]
    assert figures["all"]["gain_mean"] == pytest.approx(np.mean(gain))
    assert figures["all"]["gain_standard_error"] == pytest.approx(np.std(gain, ddof=1) / np.sqrt(8))
    assert figures["all"]["normalised_add_median"] == pytest.approx(np.median([o.add_mm for o in outcomes]) / 5)
    assert figures["all"]["gain_mean"] > 1, "a ball is located far better than by a random guess"


def test_a_study_on_the_command_line_is_resumed_and_repeats(localizer, cache, tmp_path, monkeypatch):
    out = tmp_path / "study.json"
    monkeypatch.setattr(study, "expected_random_add", lambda localizer: 5.0)
    common = ["localize", "ball", "--sensor", "gelsight-mini", "--effort", "fast"]
    common += ["--cache-dir", str(cache), "--touches", "6"]
    picture = tmp_path / "study.png"
    done = CliRunner().invoke(studies, [*common, "--out", str(out), "--plot", str(picture)])
    assert done.exit_code == 0, done.output
    whole = json.loads(out.read_text())
    assert picture.read_bytes() == draw(whole)
    entry = whole["parts"]["ball"]
    assert whole["schema"] == "geomtact/study/3" and whole["versions"]["numpy"] == np.__version__
    assert entry["settings"]["object_sha256"] == localizer.mesh.sha256 and entry["settings"]["seed"] == 1
    assert len(entry["outcomes"]) == 6 and entry["figures"]["all"]["n"] == 6

    asked = []
    monkeypatch.setattr(
        proper,
        "judge",
        lambda localizer, made, effort, seed, first: asked.append(len(made) - first) or _as_before(entry, first),
    )
    stopped = json.loads(out.read_text())
    stopped["parts"]["ball"]["outcomes"] = entry["outcomes"][:4]
    out.write_text(json.dumps(stopped))
    assert CliRunner().invoke(studies, [*common, "--out", str(out)]).exit_code == 0
    assert asked == [2]
    assert json.loads(out.read_text())["parts"]["ball"] == entry
    stopped["schema"] = "geomtact/study/2"
    (tmp_path / "older.json").write_text(json.dumps(stopped))
    older = CliRunner().invoke(studies, [*common, "--out", str(tmp_path / "older.json")])
    assert (
        older.exit_code == 3 and "expected a study of the schema geomtact/study/3, got geomtact/study/2" in older.output
    )
    held = out.read_bytes()
    other = CliRunner().invoke(studies, [*common, "--out", str(out), "--seed", "2"])
    assert other.exit_code == 3 and "other settings (seed)" in other.output
    assert asked == [2] and out.read_bytes() == held, "what was judged with other settings is kept"


@pytest.mark.parametrize(("off", "goes_on"), [(1e-7, True), (1e-3, False)])
def test_a_study_goes_on_on_another_processor(off, goes_on):
    """Whose arithmetic differs in the last digits."""
    settings = {
        "object": "ball",
        "calibration": {"temperature": 0.95, "floor": 0.005},
        "levels": [0.1, 0.2],
        "touches": 6,
    }
    entry = {"settings": json.loads(json.dumps(settings))}
    entry["settings"]["calibration"]["temperature"] *= 1 + off
    if goes_on:
        assert study_file.begun(entry, settings)
    else:
        with pytest.raises(InputError, match="other settings .calibration."):
            study_file.begun(entry, settings)


def _as_before(entry, first):
    return iter([proper.Judged(**o) for o in entry["outcomes"][first:]])


def test_a_file_that_is_no_study_is_left_alone(cache, tmp_path):
    out = tmp_path / "other.json"
    out.write_text("{}")
    done = CliRunner().invoke(studies, ["localize", "ball", "--out", str(out), "--cache-dir", str(cache)])
    assert done.exit_code == 3 and out.read_text() == "{}"


def test_touches_are_described(tmp_path):
    done = CliRunner().invoke(studies, ["samples", "ball", "--sensor", "gelsight-mini", "--touches", "6"])
    assert done.exit_code == 0, done.output
    assert "geometric" in done.output and "elastic" in done.output


def test_outcomes_are_plain_numbers(localizer):
    touches = study.make_touches(localizer.space, 1, 0, MODERATE)
    (outcome,) = proper.judge(localizer, touches, "fast", 0)
    assert json.loads(json.dumps(asdict(outcome))) == asdict(outcome)


def test_the_reference_solver_agrees_with_hertz_and_with_the_package():
    pytest.importorskip("tamaas")
    from geomtact.sensing.elastic import elastic_mask
    from tools.studies.localize.other_solver import tamaas_mask

    pitch, radius, depth = (0.1 * MM, 0.1 * MM), 20 * MM, 0.8 * MM
    x = (np.arange(121) - 60) * pitch[0]
    r2 = x**2 + x[:, None] ** 2
    ball = depth - r2 / (2 * radius)
    mask = tamaas_mask(ball, pitch)
    assert np.sqrt(mask.sum() * pitch[0] * pitch[1] / np.pi) == pytest.approx(np.sqrt(radius * depth), rel=0.015)
    assert (mask ^ elastic_mask(ball, pitch)).sum() < 0.03 * mask.sum()
    punch = np.where(r2 < (4 * MM) ** 2, depth, -np.inf)
    assert (tamaas_mask(punch, pitch) ^ (punch > 0)).sum() < 0.03 * (punch > 0).sum()


def test_the_thesis_table_counts_the_poses_that_refinement_improves():
    rows = [[8.0, 4.0, 9.0, 3.0, 2.0, 1.0], [2.0, 3.0, 1.0, 2.0, 2.0, 2.0], [6.0, 6.0, 5.0, 6.0, 4.0, 5.0]]
    figures = known_approach.summarise([known_approach.Outcome(0, True, [*row, 3.0, 3.0], 20.0) for row in rows])
    assert figures["best"]["error_mm_quartiles"][1] == 6 and figures["best"]["normalised_median"] == 0.3
    assert (figures["refined best"]["nearer"], figures["refined best"]["farther"]) == pytest.approx((1 / 3, 1 / 3))
    assert figures["thesis's refinement of best"]["nearer"] == pytest.approx(2 / 3)
    assert figures["refined best"]["near"] == [3, 6.0, 4.0]
    assert "nearer" not in figures["answer"]


def test_touches_of_a_known_contact_face_are_evaluated_before_and_after_refinement(flat_nut, monkeypatch, tmp_path):
    monkeypatch.setattr(Localizer, "prepare", classmethod(lambda cls, *args, **options: flat_nut))
    out = tmp_path / "table.json"
    args = ["thesis", "hex_nut", "--sides", "2", "--touches", "1", "--out", str(out)]
    done = CliRunner().invoke(studies, args)
    assert done.exit_code == 0, done.output
    entry = json.loads(out.read_text("utf-8"))["parts"]["hex_nut"]
    distance = PoseDistance(flat_nut.mesh)
    assert [o["side"] for o in entry["outcomes"]] == [0, 1]
    for outcome in entry["outcomes"]:
        best, _, _, answer, best10, answer10, of_modes, of_answers_modes = outcome["error_mm"]
        # ten modes hold the first
        assert of_modes <= best + 1e-6 and of_answers_modes <= answer + 1e-6
        touch = next(known_approach.touches_of_side(flat_nut, outcome["side"], 1, 1, MODERATE, True))
        grid = flat_nut.localize(touch.mask, "mask", effort=replace(EFFORTS["exact"], modes=0))
        refined = flat_nut.localize(touch.mask, "mask", effort="exact")
        near = [1e3 * distance.mean(touch.T_sensor_object, p.likeliest(10)).min() for p in (grid, refined)]
        assert near == pytest.approx([best10, answer10], abs=1e-6)
        assert 0 < outcome["random_mm"] < 100
    # a study that is whole is not made again
    monkeypatch.setattr(Localizer, "prepare", None)
    assert CliRunner().invoke(studies, args).exit_code == 0
    assert json.loads(out.read_text("utf-8"))["parts"]["hex_nut"] == entry
