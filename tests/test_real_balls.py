"""Real tactile images: balls pressed into a GelSight Mini lie where the eye sees them, and the simulated DIGIT of others runs
from RGB to a report. ``pytest -s`` prints a table of all presses."""

import csv
import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from geomtact import Localizer, Mesh, Posterior, Sensor
from geomtact.geometry.distance import PoseDistance, mode_radius
from geomtact.report.result import write_all
from geomtact.report.sensor_image import sensor_images
from geomtact.scoring import fitted
from geomtact.se3 import inverse, random_rotations, transform

pytestmark = pytest.mark.slow  # prepares 300,000 poses of two balls
CIRCLES = Path(__file__).with_name("circles_gelslam_gsmini.csv")
MM = 1e-3
DIAMETERS = ("6.310", "9.500")


@dataclass
class Press:
    """One press: what the eye saw, the posterior of the ball that was pressed, and the log evidence of both."""

    file: str
    ball: str
    inside: bool
    seen: np.ndarray  # centre of the circle drawn by eye (2,) [m]
    posterior: Posterior
    log_evidence: dict

    @property
    def centre(self):
        """Where the first mode has the ball's centre (3,) [m]; the ball's mesh is centred on its origin."""
        return self.posterior.modes(1)[0].T[:3, 3]

    @property
    def off_mm(self):
        return np.linalg.norm(self.centre[:2] - self.seen) / MM

    @property
    def mask_off_mm(self):
        rows, cols = np.nonzero(self.posterior.observation.contact.mask)
        return np.linalg.norm(self.posterior.sensor.from_pixels([cols.mean(), rows.mean()]) - self.seen) / MM

    @property
    def ratio(self):
        """How many times likelier the likelier of the two balls is."""
        small, large = (self.log_evidence[d] for d in DIAMETERS)
        return np.exp(abs(small - large))


@pytest.fixture(scope="module")
def few_touches():
    """Twice as many as elsewhere: with 60 a press over the window's border lies 0.57 mm off, 0.5 allowed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitted, "TOUCHES", 120)
        yield


@pytest.fixture(scope="module")
def balls(data_folder, cache_dir, few_touches):
    out = {}
    for diameter in DIAMETERS:
        ball = trimesh.creation.icosphere(subdivisions=5, radius=0.5 * float(diameter) * MM)
        mesh = Mesh(ball.vertices, ball.faces, f"ball of {diameter} mm", "m")
        out[diameter] = Localizer.prepare(mesh, sensor="gelsight-mini", max_poses=300_000, cache_dir=cache_dir)
    return out


@pytest.fixture(scope="module")
def presses(data_folder, balls):
    folder = data_folder / "gelslam_gsmini_balls"
    lines = [line for line in CIRCLES.read_text("utf-8").splitlines() if not line.startswith("#")]
    out = []
    for row in csv.DictReader(lines):
        seen = Sensor.load("gelsight-mini").from_pixels([float(row["cx_px"]), float(row["cy_px"])])
        found = balls[row["ball_mm"]].localize(folder / row["file"], background=folder / "background.png")
        (other,) = set(DIAMETERS) - {row["ball_mm"]}
        mask = found.observation.contact.mask
        evidence = {
            row["ball_mm"]: found.log_evidence,
            other: balls[other].localize(mask, kind="mask").log_evidence,
        }
        out.append(Press(row["file"], row["ball_mm"], row["inside"] == "1", seen, found, evidence))
    print_table(out)
    return out


def print_table(presses):
    print("\npress          off[mm] mask off  depth  P(first)  6.310 : 9.500")
    for inside, title in ((True, "wholly inside"), (False, "over the border")):
        some = [p for p in presses if p.inside == inside]
        print(f"{title} ({len(some)})")
        for p in some:
            depth = 0.5 * float(p.ball) - p.centre[2] / MM
            odds = np.exp(p.log_evidence["6.310"] - p.log_evidence["9.500"])
            first = p.posterior.modes(1)[0].probability
            print(f"{p.file:14} {p.off_mm:7.2f} {p.mask_off_mm:8.2f} {depth:6.2f} {first:9.3f} {odds:8.2f} : 1")
        off = [p.off_mm for p in some]
        print(
            f"off: median {np.median(off):.2f}, largest {max(off):.2f} mm; evidence ratio <= {max(p.ratio for p in some):.2f}"
        )


def test_a_ball_wholly_inside_lies_where_the_eye_sees_it(presses):
    """Within 0.55 mm: of the one that is farthest the contact itself lies 0.33 mm off."""
    inside = [p for p in presses if p.inside]
    assert len(inside) == 29
    assert {p.posterior.provenance.views[0].contact_method for p in inside} == {"classical"}
    assert {p.file: p.off_mm for p in inside if p.off_mm > 0.55} == {}


def test_the_whole_posterior_of_a_ball_lies_there_too(presses):
    """Not the first mode alone: the mean of x and y of all poses, which some hundred draws leave uncertain by 0.05 mm."""
    for p in presses:
        if p.inside:
            mean = np.exp(p.posterior.log_prob) @ p.posterior.poses[:, :2, 3]
            assert np.linalg.norm(mean - p.seen) <= 0.55 * MM, p.file


def test_all_rotations_of_a_ball_are_one_mode(balls, presses, rng):
    """Modes differ in where the ball is and in nothing else; turning it changes neither density nor credible level."""
    for localizer in balls.values():
        assert len(localizer.index.rotations) == 1
    turns = transform(random_rotations(5, rng), np.zeros(3))
    for p in presses[::4]:
        distance, radius = PoseDistance(p.posterior.mesh), mode_radius(p.posterior.mesh)
        modes = p.posterior.modes(5)
        for mode in modes:
            turned = mode.T @ turns
            assert distance.largest(mode.T, turned).max() < 1e-9
            assert np.ptp(p.posterior.log_density(turned)) == 0
        for a, b in itertools.combinations(modes, 2):
            apart = np.linalg.norm(a.T[:3, 3] - b.T[:3, 3])
            assert distance.mean(a.T, b.T[None])[0] == pytest.approx(apart)
            assert apart > radius


def test_a_ball_touches_no_deeper_than_the_gel(presses):
    for p in presses:
        depth = 0.5 * float(p.ball) * MM - p.centre[2]
        assert 0 <= depth <= p.posterior.sensor.max_penetration, p.file


def test_a_mask_hardly_distinguishes_the_balls(presses):
    """A small ball pressed deeper looks like a large one: no press makes either ball five times likelier."""
    assert {p.file: p.ratio for p in presses if p.ratio >= 5} == {}


def _of_marker(row, sensor):
    """T_sensor_object of the marker, from a line of ``poses_sensors.txt``: position, axis and angle of the sensor."""
    world_theirs = transform(Rotation.from_rotvec(row[3:6] / np.linalg.norm(row[3:6]) * row[6]).as_matrix(), row[:3])
    theirs_ours = transform([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [sensor.camera_distance, 0, 0.015])
    return inverse(world_theirs @ theirs_ours) @ transform(np.eye(3), [0.1, 0, 0.2])


@pytest.fixture(scope="module")
def marker(data_folder, tmp_path_factory, few_touches):
    """A localizer of a marker on a DIGIT that others simulated, and the posterior of each of their images with its
    pose, but for how deep it presses: [(posterior, T)]."""
    folder = data_folder / "hsp_digit_sim_ycb"
    localizer = Localizer.prepare(
        folder / "meshes" / "040_large_marker.obj",
        unit="m",
        sensor="digit-hsp",
        max_poses=20_000,
        cache_dir=tmp_path_factory.mktemp("cache"),
    )
    read = []
    for triplet in sorted((folder / "040_large_marker").iterdir()):
        for k, row in enumerate(np.loadtxt(triplet / "poses_sensors.txt")):
            posterior = localizer.localize(triplet / f"Image_heatmap_{k}.png", background=folder / "background.png")
            read.append((posterior, _of_marker(row, localizer.sensor)))
    assert len(read) == 12
    return localizer, read


def test_tactile_images_of_another_simulator_run_from_rgb_to_a_report(marker, tmp_path):
    localizer, read = marker
    for posterior, _ in read:
        assert posterior.contact and posterior.observation.kind == "reading"
        assert posterior.entropy_nats < 0
    posterior = read[0][0]
    write_all(tmp_path / "out", posterior, posterior.modes(3), sensor_images(posterior, localizer), {}, {})
    names = {"result.json", "posterior.npz", "report.html", "report.png"}
    assert names <= {path.name for path in (tmp_path / "out").iterdir()}


def test_tactile_images_of_another_simulator_localize_the_marker(marker):
    localizer, read = marker
    depths = np.array(localizer.index.resolution.penetrations)
    gains = []
    for posterior, T in read:
        # the marker's depth is unknown: the mean density over the depths that touch
        settled, touches = localizer.space.settle(np.tile(T, (len(depths), 1, 1)), depths)
        gains.append(np.log(np.exp(posterior.log_density(settled[touches])).mean()))
    expected = np.mean([posterior.information_gain_nats for posterior, _ in read])
    print(f"\ngain of {len(gains)} readings: {np.mean(gains):.2f} nats, expected {expected:.2f}")
    assert np.mean(gains) > 10 and np.min(gains) > 0
    assert expected < np.mean(gains) + 1, "long contacts are not found exactly, and the posterior knows"
