"""The report shows the posterior: in plain numbers, in result.json, in one picture and in one page."""

import io
import json
import re
import shutil
import subprocess
from dataclasses import dataclass, field
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from geomtact import se3
from geomtact.contact_space.touches import random_touches
from geomtact.files import write_whole
from geomtact.geometry.mesh_file import load_mesh
from geomtact.inference.facts import Diagnostics, Provenance, ViewRecord
from geomtact.json_values import plain, to_text
from geomtact.report.marginals import Samples, marginals, turn_and_tilt
from geomtact.report.result import result, write_all
from geomtact.report.sensor_image import SensorImage, sensor_images
from geomtact.report.summary import (
    MOTIONS,
    caution,
    contact_centre,
    facts,
    observable_share,
    percent,
    summaries_of,
    summarise,
)
from geomtact.sensing.cast import Caster
from geomtact.sensing.sensor import Sensor
from tools.studies.__main__ import app as studies


@dataclass
class FakeMode:
    T: np.ndarray
    probability: float = 0.5
    covariance: np.ndarray = field(default_factory=lambda: np.diag([0.01, 0.02, 0.03, 1e-4, 2e-4, 3e-4]) ** 2)
    observable: np.ndarray = field(default_factory=lambda: np.eye(6)[[0, 1, 3, 4, 5]])
    length: float = 0.01
    refined: bool = True


@dataclass
class FakeIndex:
    resolution: SimpleNamespace
    stored: np.ndarray
    angle_step: float = 0.26

    def poses(self, cells):
        return self.stored[cells]

    def __len__(self):
        return 4000


def alone(posterior, simulate):
    """The one sensor's image."""
    return [SensorImage(posterior.sensor, posterior.T_frame_sensor, posterior.observations[0], simulate)]


@pytest.fixture(scope="module")
def touch():
    """A pin that lies along the sensor's x axis, pressed 0.5 mm deep, its modes, and a cloud of poses about the first."""
    rng = np.random.default_rng(1)
    sensor, mesh = Sensor.load("gelsight-mini"), load_mesh("pin")
    caster = Caster(mesh.vertices, mesh.faces)
    lying = se3.transform(Rotation.from_euler("y", 90, degrees=True).as_matrix(), np.zeros(3))
    lying[:3, 3] = -lying[:3, :3] @ mesh.centre

    def pressed(T):
        return se3.transform(np.eye(3), [0, 0, caster.penetration(sensor, T)[0] - 0.5e-3]) @ T

    lying[2, 3] += 0.03
    modes = [
        FakeMode(pressed(se3.transform(Rotation.from_euler("z", a, degrees=True).as_matrix(), [s, 0, 0]) @ lying), p)
        for a, s, p in ((25, 0.001, 0.62), (-60, 0, 0.21), (100, 0.002, 0.1), (-10, -0.03, 0.05), (5, 0.04, 0.02))
    ]
    poses = modes[0].T @ se3.exp(rng.normal(size=(3000, 6)) * [0.05, 0.02, 0.05, 3e-4, 4e-4, 3e-4])
    log_prob = rng.normal(size=3000)
    posterior = SimpleNamespace(
        mesh=mesh,
        sensor=sensor,
        frame="sensor",
        contact=True,
        poses=poses,
        log_prob=log_prob - np.log(np.exp(log_prob).sum()),
        entropy_nats=-4.2,
        information_gain_nats=4.2,
        cells=np.arange(3000),
        refined={},
        explored=None,
        effective_poses=1234.5,
        settings={"scorer": "overlap", "temperature": np.float64(0.1), "seed": 7},
        diagnostics=Diagnostics(),
        provenance=Provenance(views=(ViewRecord(np.eye(4), "mask", None, False, True, "0"),)),
        timing_ms={"score": 12.0},
        warnings=["a <b>bold</b> warning"],
        seed=7,
        space=SimpleNamespace(caster=caster),
        index=FakeIndex(SimpleNamespace(step=5e-4, level=3, penetrations=(0.5e-3, 1.5e-3)), poses),
        T_frame_sensor=np.eye(4),
        save=lambda path: np.savez(path, poses=poses),
    )
    contact = caster.contact(sensor, modes[0].T)
    image = np.where(contact.mask, 255, 0).astype(np.uint8)
    posterior.observation = SimpleNamespace(contact=contact, kind="mask", method=None, warnings=[], image=image)
    posterior.observations = [posterior.observation]
    return posterior, modes, lambda T: caster.contact(sensor, T)


def test_all_files_are_whole_and_agree(touch, tmp_path):
    posterior, modes, simulate = touch
    content = write_all(
        tmp_path / "new" / "folder", posterior, modes, alone(posterior, simulate), {"kind": "auto"}, {"prepare": 1.0}
    )
    folder = tmp_path / "new" / "folder"
    assert sorted(p.name for p in folder.iterdir()) == ["posterior.npz", "report.html", "report.png", "result.json"]

    read = json.loads((folder / "result.json").read_text())
    assert read == content
    assert read["schema"] == "geomtact/localization/1"
    assert set(read) == {
        *("schema", "object", "sensor", "frame", "contact", "modes", "information_gain_nats"),
        *("entropy_nats", "effective_poses"),
        *("settings", "diagnostics", "versions", "timing_ms", "warnings"),
    }
    assert read["settings"] == {"scorer": "overlap", "temperature": 0.1, "kind": "auto", "seed": 7}
    assert set(read["timing_ms"]) == {"score", "prepare", "report"}
    for mode, entry in zip(modes, read["modes"], strict=True):
        T = np.array(entry["T"])
        assert np.array_equal(T, mode.T)
        assert np.allclose(entry["translation_mm"], 1e3 * T[:3, 3], atol=1e-12)
        assert np.allclose(Rotation.from_quat(entry["quat_xyzw"]).as_matrix(), T[:3, :3], atol=1e-12)

    with Image.open(folder / "report.png") as picture:
        assert picture.format == "PNG"
        assert picture.width == 1400
        colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    for colour in ("D55E00", "56B4E9", "0072B2"):  # the outline, the simulated contact, the bars
        assert (colours == list(bytes.fromhex(colour))).all(1).sum() > 100


def test_page_is_self_contained_and_escaped(touch, tmp_path):
    posterior, modes, simulate = touch
    write_all(tmp_path, posterior, modes, alone(posterior, simulate))
    html = (tmp_path / "report.html").read_text("utf-8")
    assert "a &lt;b&gt;bold&lt;/b&gt; warning" in html
    assert "<b>" not in html
    assert not re.search(r"https?:|//", re.sub(r'src="data:[^"]*"|<script.*?</script>', "", html, flags=re.DOTALL))
    scripts = re.findall(r"<script[^>]*>", html)
    assert len(scripts) == 2 and not any("src" in script for script in scripts)
    assert not re.search(r"https?:|fetch|import|XMLHttp", html.split("<script>")[1])
    parser = _Tags()
    parser.feed(html)
    assert parser.open == []
    assert parser.images == 3
    assert parser.rows == 1 + len(modes)


class _Tags(HTMLParser):
    """Checks that tags close in order; counts images and rows."""

    def __init__(self):
        super().__init__()
        self.open, self.images, self.rows = [], 0, 0

    def handle_starttag(self, tag, attrs):
        self.images += tag == "img"
        self.rows += tag == "tr"
        if tag not in ("meta", "img", "br", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
TRIED = """<script>
const errors = []; window.onerror = (message) => errors.push(message);
window.addEventListener("load", () => setTimeout(() => {
  const canvas = document.querySelector("canvas"), tabs = [...document.querySelectorAll("[role=tab]")];
  const picture = () => canvas.toDataURL();
  const chosen = () => tabs.findIndex((tab) => tab.getAttribute("aria-selected") === "true");
  const key = (target, name) => target.dispatchEvent(new KeyboardEvent("keydown", { key: name, bubbles: true }));
  const seen = [[chosen(), picture()]];
  tabs[2].click(); seen.push([chosen(), picture()]);
  key(tabs[2], "ArrowRight"); seen.push([chosen(), picture()]);
  key(canvas, "1"); seen.push([chosen(), picture()]);
  key(canvas, "ArrowLeft"); seen.push([chosen(), picture()]);
  document.querySelector("input").click(); seen.push([chosen(), picture()]);
  const pictures = seen.map((each) => each[1]);
  document.title = JSON.stringify({
    errors, chosen: seen.map((each) => each[0]), alike: pictures.map((each) => pictures.indexOf(each)) });
}, 500));
</script>"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open the page with")
@pytest.mark.slow
def test_the_page_in_a_browser(touch, tmp_path):
    """Without a network it opens without an error, draws the object, and changes modes on click and by key.

    Each picture is another one, but that of the first mode comes back as it was."""
    posterior, modes, simulate = touch
    write_all(tmp_path, posterior, modes, alone(posterior, simulate))
    page = tmp_path / "tried.html"
    page.write_text((tmp_path / "report.html").read_text("utf-8").replace("<head>", "<head>" + TRIED), "utf-8")
    options = [
        "--headless",
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--window-size=1200,1600",
    ]
    options += [f"--user-data-dir={tmp_path / 'browser'}", "--virtual-time-budget=5000"]
    printed = subprocess.run(
        [CHROMIUM, *options, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=120, check=True
    ).stdout
    found = json.loads(unescape(re.search("<title>(.*)</title>", printed)[1]))
    assert found == {"errors": [], "chosen": [0, 2, 3, 0, 0, 0], "alike": [0, 1, 2, 0, 4, 5]}
    kept = Path(__file__).parents[1] / "out" / "screenshots"
    kept.mkdir(parents=True, exist_ok=True)
    report = (tmp_path / "report.html").as_uri()
    subprocess.run(
        [CHROMIUM, *options, f"--screenshot={kept / 'report.png'}", report],
        capture_output=True,
        timeout=120,
        check=True,
    )
    assert (kept / "report.png").stat().st_size > 20_000


def test_no_contact_still_makes_a_report(touch, tmp_path):
    posterior, _, simulate = touch
    empty = SimpleNamespace(
        **{**vars(posterior), "contact": False, "poses": np.zeros((0, 4, 4)), "log_prob": np.zeros(0)}
    )
    seen = posterior.observations[0]
    nothing = SimpleNamespace(mask=np.zeros_like(seen.contact.mask), height=None)
    empty.observation = SimpleNamespace(contact=nothing, kind="mask", method=None, image=np.zeros_like(seen.image))
    empty.observations = [empty.observation]
    content = write_all(tmp_path, empty, [], alone(empty, simulate))
    assert content["modes"] == []
    assert content["contact"] is False
    assert "No contact" in (tmp_path / "report.html").read_text()
    assert (tmp_path / "report.png").stat().st_size > 1000


def test_result_has_no_numbers_that_json_lacks(touch):
    posterior, modes, _ = touch
    lost = FakeMode(modes[0].T, covariance=np.full((6, 6), np.inf))
    text = to_text(result(posterior, [lost]))
    assert json.loads(text)["modes"][0]["covariance"] == [[None] * 6] * 6
    assert plain({"a": np.float32(0.5), 2: (np.nan, True, None)}) == {"a": 0.5, "2": [None, True, None]}


def test_a_failed_write_leaves_the_old_file(tmp_path):
    target = tmp_path / "file.txt"
    target.write_text("old")

    def fail(path):
        path.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_whole(target, fail)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("file.txt", "old")]


def test_observable_directions_match_finite_differences(rng):
    """A motion about the contact is observable by as much of it as lies outside the unobservable motions."""
    T = se3.transform(se3.random_rotations(1, rng)[0], rng.normal(size=3) * 0.02)
    about, length, step = rng.normal(size=3) * 0.01, 0.013, 1e-7
    scale = np.array([length] * 3 + [1] * 3)
    basis = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    rows, lost = basis[:4], basis[4:]
    shares = observable_share(FakeMode(T, observable=rows, length=length), about)
    there, back = se3.transform(np.eye(3), about), se3.transform(np.eye(3), -about)
    carried = [scale * se3.log(back @ T @ se3.exp(step * n / scale) @ se3.inverse(T) @ there) for n in lost]
    untold = np.linalg.qr(np.array(carried).T)[0]
    for k, name in enumerate(MOTIONS):
        assert shares[name] == pytest.approx(1 - (untold[k] ** 2).sum(), abs=1e-5)


def test_summary_in_words_and_numbers(rng):
    T = se3.transform(Rotation.from_euler("z", 30, degrees=True).as_matrix(), [0.001, 0.002, 0.003])
    centre = np.array([0.01, 0, 0])
    summary = summarise(FakeMode(T), centre)
    assert np.allclose(summary.centre_mm, 1e3 * (T[:3, :3] @ centre + T[:3, 3]))
    assert np.allclose(summary.rotvec_deg, [0, 0, 30])
    assert summary.rotation_sd_deg == pytest.approx(np.degrees(0.03))
    xi = rng.multivariate_normal(np.zeros(6), FakeMode(T).covariance, 20_000)
    moved = (T @ se3.exp(xi))[:, :3] @ np.append(centre, 1)
    assert summary.centre_sd_mm == pytest.approx(1e3 * np.sqrt(np.linalg.eigvalsh(np.cov(moved.T))[-1]), rel=0.03)
    flat = FakeMode(np.eye(4), observable=np.eye(6)[[0, 1, 5]])
    assert summarise(flat, centre).in_words() == "fixed: tilt x, tilt y, shift z; not: turn z, shift x, shift y"
    half = FakeMode(np.eye(4), observable=np.array([[0, 0, 0, 1, 1, 0]]) / np.sqrt(2))
    assert summarise(half, centre).in_words() == "partly: shift x, shift y; not: tilt x, tilt y, turn z, shift z"
    assert summarise(FakeMode(T, observable=np.zeros((0, 6))), centre).in_words() == "unknown"
    assert summarise(FakeMode(T, observable=np.eye(6)), centre).in_words() == "fixed: all six motions"
    assert "unknown" in summarise(FakeMode(T, covariance=np.full((6, 6), np.nan)), centre).cells(1)


@pytest.mark.parametrize("turn, tilt", [(0, 0), (170, 20), (-35, 80), (90, 179)])
def test_turn_and_tilt_compose(turn, tilt, rng):
    first = se3.random_rotations(1, rng)[0]
    axis = np.array([np.cos(1.0), np.sin(1.0), 0])
    R = Rotation.from_euler("z", turn, degrees=True) * Rotation.from_rotvec(np.radians(tilt) * axis)
    found = turn_and_tilt((R.as_matrix() @ first)[None], first, None)
    assert np.allclose(np.concatenate(found), [turn, tilt], atol=1e-6)


@pytest.mark.parametrize("name", ["hex_nut", "damping_pin"])
def test_turns_of_the_symmetry_count_for_nothing(name, rng):
    symmetry = load_mesh(name).symmetry
    first = se3.random_rotations(1, rng)[0]
    images = symmetry.sampled()[:, :3, :3]
    turn, tilt = turn_and_tilt(first @ images, first, symmetry)
    assert np.abs(turn).max() < 1e-3
    assert tilt.max() < 1e-3


def test_marginals_hold_the_mass(touch):
    posterior, modes, _ = touch
    found = marginals(posterior, modes[0].T)
    assert [s.label for s in found] == [
        *(f"centre {axis}, sensor frame [mm]" for axis in "xyz"),
        "turn about z from mode 1 [°]",
        "tilt from mode 1 [°]",
    ]
    for samples in found:
        assert samples.weights.sum() == pytest.approx(1)
        mass, edges = samples.histogram()
        assert mass.sum() >= 0.998
        assert len(mass) <= 36
        assert edges[0] <= samples.mark <= edges[-1]
        in_steps = np.diff(edges) / samples.step
        assert np.allclose(in_steps, np.round(in_steps))
    weights = np.exp(posterior.log_prob)
    mean = weights @ (posterior.poses[:, 0, :3] @ posterior.mesh.centre + posterior.poses[:, 0, 3])
    # a comb through the distribution stands for it
    assert found[0].values @ found[0].weights == pytest.approx(1e3 * mean, abs=0.01 * found[0].values.std())


def test_the_grid_does_not_show_as_a_comb():
    values = np.repeat(np.arange(-40, 40) * 0.75, 3)
    mass, edges = Samples("x", values, np.full(240, 1 / 240), 0.0, 0.75).histogram()
    assert np.ptp(mass[1:-1]) < 1e-12
    alone, _ = Samples("x", np.zeros(5), np.full(5, 0.2), 0.0, 0.75).histogram()
    assert alone.max() == pytest.approx(1)


@pytest.mark.parametrize("mark", [-3.3, 0.0, 4.1])
@pytest.mark.parametrize("most", [8, 36])
def test_no_edge_of_a_histogram_falls_on_the_grid(mark, most):
    """Every bin but those at the ends holds as many of the grid's lines, wherever rounding puts them."""
    lines = 0.7 * np.arange(-40, 41) + 1e-13 * np.random.default_rng(0).normal(size=81)
    mass, _ = Samples("x", lines, np.full(81, 1 / 81), mark, 0.7).histogram(most)
    held = np.round(81 * mass).astype(int)
    inner = held[np.flatnonzero(held)[1] : np.flatnonzero(held)[-1]]
    assert held.sum() >= 80 and len(set(inner)) == 1, held


def test_contact_centre_is_the_pressed_spot():
    sensor = Sensor.load("gelsight-mini")
    x, y = sensor.pixel_centres()
    mask = np.hypot(x - 2e-3, y[:, None] + 1e-3) < 1e-3
    assert np.allclose(contact_centre(SimpleNamespace(mask=mask), sensor), [2e-3, -1e-3, 0], atol=2e-5)
    assert np.array_equal(contact_centre(SimpleNamespace(mask=mask & False), sensor), np.zeros(3))


def test_facts_are_sentences(touch):
    posterior, _, _ = touch
    lines = facts(posterior)
    assert lines == ["Information gain: 4.2 nats; 1 in 67 of all touching poses remains."]
    assert _said_of(posterior, None) == lines
    assert _said_of(posterior, "learned") == ["Method of contact detection: learned.", *lines]
    several = _said_of(posterior, "learned", None, "classical", "learned")
    assert several == ["Method of contact detection: classical and learned.", *lines]


def _said_of(posterior, *methods):
    """Facts of a posterior of contacts that were found so."""
    views = tuple(ViewRecord(np.eye(4), "reading", method, False, True, "0") for method in methods)
    return facts(SimpleNamespace(**{**vars(posterior), "provenance": Provenance(views=views)}))


def test_a_mode_that_holds_little_is_not_believed(touch, tmp_path):
    posterior, modes, simulate = touch
    assert [percent(p) for p in (0.62, 0.0012, 0.0004, 0.0)] == ["62.0 %", "0.1 %", "< 0.1 %", "< 0.1 %"]
    assert caution(summaries_of(posterior, modes)) == caution([]) == []
    weak = [FakeMode(modes[0].T, 0.0003)]
    warned = ["The object is probably not at mode 1, which holds < 0.1 %; touch again, or give a prior."]
    assert caution(summaries_of(posterior, weak)) == warned
    write_all(tmp_path, posterior, weak, alone(posterior, simulate), timing_ms={"prepare": 1.23456})
    html = (tmp_path / "report.html").read_text("utf-8")
    assert "mode 1, which holds &lt; 0.1 %" in html
    assert "within the mode" in html
    assert re.search(r"^prepare: 1\.2$", html, re.MULTILINE)


def test_angles_are_drawn_within_their_range():
    from matplotlib.figure import Figure

    from geomtact.report.figure import draw_marginals

    turns = np.linspace(-180, 180, 500)
    samples = Samples("turn", turns, np.full(500, 1 / 500), 0.0, 7.0, -180.0, 180.0)
    figure = Figure()
    draw_marginals(figure.subfigures(), [samples])
    assert figure.axes[0].get_xlim() == (-180, 180)


def test_printed_text_is_one_line(ball, a_touch):
    touched = ball.localize(a_touch(ball)[1])
    nothing = ball.localize(np.zeros_like(a_touch(ball)[1]))
    for shown in (ball, ball.index, ball.mesh, touched, nothing, touched.modes(1)[0]):
        assert "\n" not in repr(shown)
        assert len(repr(shown)) < 120
        assert repr(shown) == str(shown)
    for shown in (ball, touched):
        assert all(word in repr(shown) for word in ("ball", "gelsight-mini", f"{len(ball.index):,} poses"))
    assert f"{-touched.entropy_nats:.1f} nats" in repr(touched)
    assert "no contact" in repr(nothing)


def test_pictures_open(touch):
    from geomtact.report.figure import draw

    posterior, modes, simulate = touch
    picture = draw(posterior, modes[:2], summaries_of(posterior, modes[:2]), alone(posterior, simulate))
    sizes = {name: Image.open(io.BytesIO(png)).size for name, png in picture.bands.items()}
    assert sum(height for _, height in sizes.values()) == Image.open(io.BytesIO(picture.whole)).height


@pytest.mark.slow
def test_several_sensors_are_shown_in_their_order(plug, rng):
    """A row for each, also for one without contact, with its predicted contact at each mode."""
    from geomtact.report.figure import draw

    touches = random_touches(plug.space, 2, 5)
    T = se3.transform(se3.random_rotations(1, rng)[0], [0.1, 0, 0])
    sensors = [T @ se3.inverse(touch.T_sensor_object) for touch in touches]
    far = se3.transform(np.eye(3), [0, 0, 0.5]) @ sensors[0]
    images = [np.zeros_like(touches[0].mask), *(touch.mask for touch in touches)]
    posterior = plug.localize(images, "mask", None, np.stack([far, *sensors]))
    shown = sensor_images(posterior, plug)
    assert [one.name for one in shown] == ["sensor 1", "sensor 2", "sensor 3"]
    for one, image, at in zip(shown, images, [far, *sensors], strict=True):
        np.testing.assert_array_equal(one.observation.contact.mask, image)
        np.testing.assert_array_equal(one.T_frame_sensor, at)
        assert one.at(T).mask.any() == image.any()
    modes = posterior.modes(2)
    several, one = (draw(posterior, modes, summaries_of(posterior, modes), some) for some in (shown, shown[1:2]))
    tall, short = (Image.open(io.BytesIO(picture.whole)).height for picture in (several, one))
    assert tall > 2 * short


# --- studies


@pytest.mark.parametrize(
    ("study", "which", "picture"),
    [
        ("choices", None, "speed-accuracy"),
        ("choices", "ablations", "no-more-than-needed"),
        ("kitting", None, "kitting"),
        ("localize", None, "calibration"),
        ("next_touch", None, "next_touch"),
        ("registration", None, "registration"),
        ("scores", None, "scores"),
        ("stability", None, "stability"),
        ("thesis", None, "thesis"),
        ("touches", None, "touches"),
        ("track", None, "track"),
    ],
)
@pytest.mark.studies
def test_every_committed_picture_is_drawn_from_its_study_alone(study, which, picture, tmp_path):
    """Pixel for pixel."""
    docs = Path(__file__).parents[1] / "docs"
    arguments = [
        str(docs / "results" / f"{study}.json"),
        str(tmp_path / "again.png"),
        *(["--picture", which] if which else []),
    ]
    shown = CliRunner().invoke(studies, ["plot", *arguments])
    assert shown.exit_code == 0, shown.output
    committed = Image.open(docs / "images" / f"{picture}.png")
    again = Image.open(tmp_path / "again.png")
    assert np.array_equal(np.asarray(again), np.asarray(committed))


def test_a_file_without_a_study_is_not_drawn(tmp_path):
    (tmp_path / "a.json").write_text('{"schema": "geomtact/other/1"}', "utf-8")
    (tmp_path / "b.json").write_text("[1]", "utf-8")
    for name, why in (
        ("a.json", "no picture is drawn of"),
        ("b.json", "no JSON of a study"),
        ("c.json", "cannot be read"),
    ):
        shown = CliRunner().invoke(studies, ["plot", str(tmp_path / name), str(tmp_path / "out.png")])
        assert shown.exit_code == 3 and why in shown.output and not (tmp_path / "out.png").exists()
