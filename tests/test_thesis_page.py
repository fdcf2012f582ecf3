"""Laws of the poses with equivalent contacts, of the ambiguity they leave, and of the page that compares with the thesis."""

import json
import re
from itertools import combinations, islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from geomtact import Localizer, Sensor, load_mesh
from geomtact.contact_space.space import ContactSpace
from geomtact.contact_space.store import open_index
from geomtact.contact_space.touch import simulate_mask
from geomtact.contact_space.touches import Touch, each_touch, random_touches
from geomtact.geometry.distance import PoseDistance
from geomtact.se3 import transform
from geomtact.sensing.noise import CLEAN, HEAVY, MODERATE
from tools.studies.__main__ import app as studies
from tools.studies.thesis import alike as search
from tools.studies.thesis import ambiguity, known_approach
from tools.studies.thesis.alike import SPACING_MM, climbed, overlap, overlap_of_readings
from tools.studies.thesis.known_approach import ROWS, Outcome, granularity
from tools.studies.thesis.plot import draw_thesis

pytestmark = pytest.mark.studies

DOCS = Path(__file__).parents[1] / "docs"
MM = 1e-3
SIDEWAYS = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # a rod along x of the sensor, its side down


@pytest.fixture(scope="module")
def rod(tmp_path_factory, cache_dir):
    """A smooth rod, 200 mm long along its own x and 16 mm thick, touched from one side of it."""
    turned = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0])
    path = tmp_path_factory.mktemp("rod") / "rod.stl"
    trimesh.creation.cylinder(8, 200, sections=64).apply_transform(turned).export(path)
    sensor = Sensor.load("gelslim")
    mesh, side = load_mesh(path, "mm", sensor=sensor), [((0.0, 1.0, 0.0), 0.0)]
    index = open_index(mesh, sensor, side, 8_000, cache_dir, None)
    return SimpleNamespace(mesh=index.mesh, sensor=sensor, index=index, space=ContactSpace(index.mesh, sensor, side))


@pytest.fixture(scope="module")
def seen(rod):
    """Touches of the rod's middle and of one end, with the equivalent poses and the overlap that makes them so."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "STARTS", 60)
        patch.setattr(search, "_JUDGED", 30)
        touches = {"middle": touch_of(rod, 0.0), "end": touch_of(rod, 0.09)}
        return {name: (t, *search.alike(rod, t, MODERATE, np.random.default_rng(0))) for name, t in touches.items()}


def touch_of(rod, x):
    """The rod pressed 1 mm deep, its middle at ``x`` [m] of the sensor."""
    T, ok = rod.space.settle(transform(SIDEWAYS, [x, 0, 0.0])[None], 1 * MM)
    assert ok[0] and np.isfinite(rod.space.penetration(T)[0])
    return Touch(T[0], 1 * MM, simulate_mask(rod.space, T[0], True), True)


def test_a_rod_may_lie_anywhere_along_itself_and_not_across(rod, seen):
    _, T, needed = seen["middle"]
    middle = T[:, :3, :3] @ rod.mesh.centre + T[:, :3, 3]
    # it is longer than the window by 155 mm: of the length along which it slides unfelt at least half is found
    assert np.ptp(middle[:, 0]) > 75 * MM
    assert np.abs(middle[:, 0]).max() < 80 * MM
    assert np.abs(middle[:, 1]).max() < 2 * MM
    along = T[:, :3, 0]
    assert np.abs(along[:, 0]).min() > np.cos(np.radians(6))
    assert 0.6 < needed < 1


@pytest.mark.parametrize("where", ["middle", "end"])
def test_poses_with_the_same_contact_lie_apart(rod, seen, where):
    touch, T, needed = seen[where]
    assert np.allclose(T[0], touch.T_sensor_object)
    truth = simulate_mask(rod.space, T[0], True, (72, 96))
    assert all(overlap(truth, simulate_mask(rod.space, one, True, (72, 96))) >= needed for one in T)
    assert np.isfinite(rod.space.penetration(T)).all()
    distance = PoseDistance(rod.mesh)
    for i, j in combinations(range(len(T)), 2):
        assert distance.mean(T[i], T[j][None])[0] >= SPACING_MM * MM - 1e-9


def test_a_touched_end_measures_the_position_along_the_rod(rod, seen):
    (_, middle, _), (_, end, _) = seen["middle"], seen["end"]
    assert len(end) < len(middle) / 4
    assert np.abs(end[:, 0, 3] - 0.09).max() < 5 * MM


def test_overlap_is_one_with_itself_and_none_where_nothing_is_shared(rng):
    masks = rng.random((5, 8, 9)) < 0.4
    assert np.array_equal(np.diag([overlap(m, masks) for m in masks]), np.ones(5))
    assert overlap(masks[0], masks[1]) == overlap(masks[1], masks[0])
    assert overlap(masks[0], ~masks[0]) == 0
    assert overlap(np.zeros((8, 9), bool), np.zeros((8, 9), bool)) == 0


def test_the_more_noise_the_less_two_masks_overlap(rod):
    mask = touch_of(rod, 0.0).mask
    needed = [overlap_of_readings(mask, rod.space, n, np.random.default_rng(0)) for n in (CLEAN, MODERATE, HEAVY)]
    assert needed[0] == 1 > needed[1] > needed[2] > 0


def test_climbing_never_goes_down_and_reaches_a_near_top(rng):
    top = np.array([3.0, -2.0, 0.5]) * MM
    starts = np.stack([transform(np.eye(3), top + rng.normal(0, 3 * MM, 3)) for _ in range(20)])

    def merit(T):
        return -np.linalg.norm(T[:, :3, 3] - top, axis=1)

    T, reached = climbed(starts, merit, np.zeros(3), np.array([0, 0, 0, 2, 2, 2]) * MM, 6, 0.0, rng)
    assert (reached >= merit(starts)).all() and np.allclose(reached, merit(T))
    assert np.median(-reached) < 0.3 * np.median(-merit(starts))


def test_the_best_guess_is_no_worse_than_the_truth_and_than_a_random_one():
    line = np.arange(12.0)
    span, guess, least = ambiguity.errors(np.abs(line[:, None] - line))
    assert (span, guess) == (11, 5.5)
    assert least == pytest.approx(3.0)  # from the middle
    assert ambiguity.errors(np.zeros((1, 1))) == (0, 0, 0)


def test_a_posterior_on_exactly_the_equivalent_poses_has_precision_and_recall_one(rod):
    distance = PoseDistance(rod.mesh)
    here, there = transform(SIDEWAYS, [0, 0, 0]), transform(SIDEWAYS, [0.09, 0, 0])

    def posterior_of(poses, level):
        draw = lambda n, rng: np.repeat(poses, -(-n // len(poses)), 0)[:n]  # noqa: E731
        return SimpleNamespace(contact=True, sample=draw, credible_level=level)

    def shares(posterior, T):
        return ambiguity.held(posterior, np.stack(T), distance, np.random.default_rng(0))

    assert shares(posterior_of([here, there], lambda T: np.full(len(T), 0.5)), [here, there]) == (1, 1)
    assert shares(posterior_of([here, there], lambda T: np.full(len(T), 0.5)), [here]) == (0.5, 1)
    assert shares(posterior_of([here], lambda T: np.where(T[:, 0, 3] < 0.01, 0.5, 1.0)), [here, there]) == (1, 0.5)
    assert shares(SimpleNamespace(contact=False), [here]) == (0, 0)


def test_distinctive_and_ambiguous_touches_have_separate_figures():
    outcomes = [Outcome(side, True, [float(10 * side + k)] * len(ROWS), 50.0) for side in (0, 1) for k in range(3)]
    found = [
        ambiguity.Ambiguity(side, k, 2, 0.8, span, span / 2, span / 2, 0.5, 1.0)
        for side, k, span in ((0, 0, 5.0), (0, 1, 40.0), (1, 0, 9.9), (1, 1, 10.0))
    ]
    figures = ambiguity.summarise(found, outcomes, 3)
    assert (figures["n"], figures["distinctive"]) == (4, 0.5)
    medians = {kind: table["best"]["error_mm_quartiles"][1] for kind, table in figures["table"].items()}
    assert medians == {"all": 5.5, "distinctive": 5.0, "ambiguous": 6.0}


def test_touches_come_one_by_one_as_they_do_at_once(flat_nut):
    at_once = random_touches(flat_nut.space, 6, 3, False, MODERATE)
    for one, other in zip(islice(each_touch(flat_nut.space, 6, 3, False, MODERATE), 4), at_once, strict=False):
        assert np.array_equal(one.T_sensor_object, other.T_sensor_object)
        assert np.array_equal(one.mask, other.mask)


def test_the_grids_neighbours_lie_about_a_step_apart(flat_nut):
    step = 1e3 * flat_nut.index.resolution.step
    assert 0.3 * step < granularity(flat_nut, 30) <= 2 * step


def test_an_interrupted_ambiguity_study_resumes_and_keeps_its_results(flat_nut, monkeypatch, tmp_path):
    monkeypatch.setattr(Localizer, "prepare", classmethod(lambda cls, *args, **options: flat_nut))
    out, plot = tmp_path / "table.json", tmp_path / "table.png"
    monkeypatch.setattr(search, "STARTS", 10)

    def judged_at_once(localizer, side, n, *_):
        return [Outcome(side, False, [1.0 + k for k in range(len(ROWS))], 50.0)] * n

    monkeypatch.setattr(known_approach, "judge_side", judged_at_once)
    args = ["thesis", "hex_nut", "--felt", "rigid", "--sides", "2", "--touches", "1", "--out", str(out)]

    def run(*more):
        done = CliRunner().invoke(studies, [*args, *more])
        assert done.exit_code == 0, done.output
        return json.loads(out.read_text("utf-8"))["parts"]["hex_nut"]

    content = run()
    assert "ambiguity" not in content and len(content["granularity_mm"]) == 2
    both = run("--ambiguity", "1", "--plot", str(plot))
    assert both["outcomes"] == content["outcomes"] and both["figures"] == content["figures"]
    assert [(a["side"], a["touch"]) for a in both["ambiguity"]["outcomes"]] == [(0, 0), (1, 0)]
    assert plot.read_bytes()[:4] == b"\x89PNG"
    # whole, it is not made again, and judging anew forgets nothing
    monkeypatch.setattr(Localizer, "prepare", None)
    assert run("--ambiguity", "1") == both
    assert run() == both


def _cells(page, heading, column=0):
    """Rows of the first table below a heading, by their entry in ``column``."""
    below = page[page.index(heading) :]
    table = below[below.index("\n|") + 1 :].split("\n\n")[0].splitlines()
    rows = [[cell.strip(" *") for cell in line.strip("|").split("|")] for line in table[2:]]
    return rows if column is None else {row[column]: row for row in rows}


def _of(figures, row):
    return f"{figures[row]['error_mm_quartiles'][1]:.1f} / {figures[row]['normalised_median']:.2f}"


def test_the_page_agrees_with_the_study():
    page = (DOCS / "thesis.md").read_text("utf-8")
    parts = json.loads((DOCS / "results" / "thesis.json").read_text("utf-8"))["parts"]
    table = _cells(page, "## Table 1", None)
    for name, part in parts.items():
        ours = next(row for row in table if row[:2] == [name, "here"])
        rows = ("best", "refined best", "answer", "best10", "answer10", "ten modes", "answer's ten modes")
        assert ours[2:] == [_of(part["figures"], row) for row in rows]
        open_ = part["ambiguity"]["figures"]
        left = _cells(page, "## What a touch leaves open")[name]
        mean = open_["mean"]
        share = f"{100 * open_['distinctive']:.0f} %"
        means = [f"{mean[key]:.0f} mm" for key in ("random_mm", "least_mm")]
        error = [f"{open_['table']['all'][row]['error_mm_mean']:.0f} mm" for row in ("answer", "best")]
        shares = [f"{100 * mean[key]:.0f} %" for key in ("precision", "recall")]
        assert left[1:] == [str(open_["n"]), share, f"{open_['median']['span_mm']:.0f} mm", *means, *error, *shares]
        before, after = (part["figures"][row]["near"] for row in ("refined best", "thesis's refinement of best"))
        moved = [f"{mm:.1f} mm" for mm in (*before[1:], after[2])]
        assert _cells(page, "### Refinement alone")[name][1:] == [str(before[0]), *moved]
        few = _cells(page, "### Distinctive touches")[name]
        distinctive = open_["table"]["distinctive"]
        assert few[1:-1] == [str(distinctive["best"]["n"]), *(_of(distinctive, row) for row in rows)]
    for image in re.findall(r"\]\((images/[^)]+)\)", page):
        assert (DOCS / image).read_bytes()[:4] == b"\x89PNG"


def test_the_picture_is_drawn_from_the_file_alone():
    content = json.loads((DOCS / "results" / "thesis.json").read_text("utf-8"))
    assert draw_thesis(content)[:4] == b"\x89PNG"
