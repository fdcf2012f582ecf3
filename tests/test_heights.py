"""Depth maps: what counts as contact, how likely poses are, and object identification."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from speed import slow_but
from typer.testing import CliRunner

from geomtact import GaussianPrior, Localizer, Mesh, Sensor, contact_mask
from geomtact.cli import app
from geomtact.contact_space.contact_maps import ContactMaps, located
from geomtact.contact_space.touch import simulate_depth_map, simulate_mask
from geomtact.contact_space.touches import random_touches
from geomtact.inference.effort import GRID_ALONE
from geomtact.scoring import contact_likelihood
from geomtact.scoring.contact_likelihood import ContactQuery, indentation_of
from geomtact.se3 import transform
from geomtact.sensing.contact import Contact
from geomtact.sensing.elastic import elastic_contact
from geomtact.sensing.image_file import read_image
from geomtact.sensing.reading import read_observation
from geomtact.sensing.render import Lamps, example_reading, render
from geomtact.sensing.sensor import CONTACT_METHODS, HEIGHT_NOISE
from tools.studies.readings.groove import read_scan
from tools.studies.readings.study import BALLS, calibrations, cameras, circles_of, localize_balls

CIRCLES = Path(__file__).with_name("circles_gelslam_gsmini.csv")
MM = 1e-3
SENSOR = Sensor("small", (160, 120), (0.1 * MM, 0.1 * MM), 0.0, 2 * MM, height_noise=0.03 * MM)
BALL = 4 * MM  # radius


def under_ball(depth, centre=(0.0, 0.0), radius=BALL):
    """How far a ball lies below the membrane (H, W) [m]: a negative number where it is above."""
    x, y = SENSOR.pixel_centres()
    off2 = (x[None] - centre[0]) ** 2 + (y[:, None] - centre[1]) ** 2
    return np.where(off2 < radius**2, depth - radius + np.sqrt(np.maximum(radius**2 - off2, 0)), -np.inf)


@pytest.fixture(scope="module")
def balls(make_localizer):
    """The ball, and one half as large again."""
    out = []
    for radius in (BALL, 1.5 * BALL):
        mesh = trimesh.creation.icosphere(subdivisions=5, radius=radius)
        ball = Mesh(mesh.vertices, mesh.faces, f"ball {radius / MM:g}", "m")
        out.append(make_localizer(ball, SENSOR, max_poses=15_000, touches=120))
    return out


def test_a_rigid_gel_is_touched_where_it_is_pressed_in():
    height = np.maximum(under_ball(0.8 * MM), 0).astype(np.float32)
    assert np.array_equal(Contact.of_height(height).mask, height > 0.01 * height.max())
    plate = np.full_like(height, 0.6 * MM)  # it fills the window
    plate[:, 60:80] = 0.2 * MM  # but for a groove
    assert Contact.of_height(plate).mask.all()
    nothing = Contact.of_height(np.zeros_like(height))
    assert not nothing.mask.any()


def test_beside_an_elastic_contact_the_gel_sinks_and_is_not_touched():
    touched, height = elastic_contact(under_ball(0.8 * MM), SENSOR.pixel_pitch)
    found = Contact.of_height(np.where(height > 0.02 * MM, height, 0))
    assert (height > 0.02 * MM).sum() > 3 * touched.sum()
    assert (found.mask & touched).sum() / (found.mask | touched).sum() > 0.9
    assert (touched & found.sure).sum() == found.sure.sum() > 0.5 * touched.sum()


@pytest.mark.parametrize("radius", [1 * MM, 2 * MM, 3 * MM])
def test_beside_a_flat_punch_hardly_anything_that_is_not_touched_counts_as_touched(radius):
    x, y = SENSOR.pixel_centres()
    punch = np.where(np.hypot(x[None], y[:, None]) < radius, 0.6 * MM, -1 * MM)
    touched, height = elastic_contact(punch, SENSOR.pixel_pitch)
    found = Contact.of_height(height)
    assert (found.mask & touched).sum() >= 0.99 * touched.sum() and found.mask.sum() < 1.2 * touched.sum()
    assert found.sure.sum() <= found.mask.sum()


@pytest.mark.slow
def test_sensors_of_one_kind_keep_their_own_calibration(tmp_path):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=BALL)
    pair = [replace(SENSOR, height_noise=n * MM) for n in (0.02, 0.2)]
    both = Localizer.prepare(
        Mesh(mesh.vertices, mesh.faces, "ball", "m"), sensor=pair, max_poses=2_000, cache_dir=tmp_path
    )
    assert [each.sensor.height_noise for each in (both, *both.others)] == pytest.approx([0.02 * MM, 0.2 * MM])


@pytest.mark.parametrize("elastic", [False, True])
def test_of_all_penetrations_the_true_one_is_likeliest_on_any_gel(balls, elastic):
    ball, depths = balls[0], 0.05 * MM * np.arange(1, 31)
    T = np.stack([transform(np.eye(3), [1 * MM, -0.7 * MM, BALL - d]) for d in depths])
    at = np.abs(depths - 0.8 * MM).argmin()
    contact = Contact.of_height(simulate_depth_map(ball.space, T[at], elastic))
    query = ContactQuery.of(contact.soft_mask, SENSOR, indentation=indentation_of(contact, SENSOR))
    poses, membrane = located(ball.index, T)
    assert depths[query.compare(ball.index, poses, membrane)[1].argmax()] == pytest.approx(depths[at], abs=0.06 * MM)


def test_gel_without_contact_lowers_only_poses_that_would_enter_it(balls):
    """And depths that were not measured count for nothing."""
    ball = balls[0]
    T = np.stack([transform(np.eye(3), [0, 0, BALL + z * MM]) for z in (0.1, -0.8)])
    poses, membrane = located(ball.index, T)
    maps, losses = ContactMaps.of(ball.index), []
    for measured in (160, 80, 0):
        height = np.zeros((120, 160), np.float32)
        height[:, measured:] = np.nan
        indentation = indentation_of(Contact(height > 0, height), SENSOR)
        losses.append(maps.depth_loss(indentation, poses, membrane))
    assert [each[0] for each in losses] == [0, 0, 0] and losses[0][1] > 10 and losses[2][1] == 0
    assert losses[1][1] == pytest.approx(losses[0][1] / 2, rel=0.1)


def test_the_sinking_of_a_thin_gel_dies_away_sooner():
    far, areas = [], []
    for thickness in (np.inf, 5 * MM, 2 * MM):
        touched, height = elastic_contact(under_ball(0.8 * MM), SENSOR.pixel_pitch, thickness)
        far.append(float(height[60, 80 + 45]))
        areas.append(int(touched.sum()))
        assert height[touched] == pytest.approx(under_ball(0.8 * MM)[touched], abs=2e-3 * 0.8 * MM)
    assert far == sorted(far, reverse=True) and far[0] > 2 * far[-1]
    assert areas == sorted(areas)


def test_scores_of_a_contour_line_belong_to_deeper_poses(balls):
    ball = balls[0]
    score = np.arange(ball.index.height.size, dtype=np.float32).reshape(ball.index.height.shape)
    step = ball.sensor.max_penetration / len(score)
    deeper = ball.index.deeper(score, 2.2 * step)
    assert np.array_equal(deeper[2:], score[:-2]) and (deeper[:2] == score.min()).all()
    assert ball.index.deeper(score, 0.4 * step) is score
    assert np.array_equal(ball.index.deeper(score, 99 * step)[-1], score[0])


@pytest.mark.parametrize("elastic", [False, True])
def test_heights_measure_the_depth_and_the_size_of_a_ball(balls, elastic):
    ball, other = balls
    T = transform(np.eye(3), [1 * MM, -0.7 * MM, BALL - 0.7 * MM])
    height = simulate_depth_map(ball.space, T) if elastic else ball.simulate(T).height
    posterior = ball.localize(height.astype(np.float32))
    assert posterior.observation.kind == "height"
    mode = posterior.modes(1)[0]
    assert mode.T[:3, 3] == pytest.approx(T[:3, 3], abs=0.1 * MM)
    assert posterior.log_evidence > other.localize(height.astype(np.float32)).log_evidence + 0.5
    masks = [each.localize(simulate_mask(ball.space, T, elastic)).log_evidence for each in (ball, other)]
    # a mask hardly does: by no more than the evidences err that are fitted on so few touches
    assert abs(masks[0] - masks[1]) < 1.5


def test_a_gel_at_rest_shows_its_background_and_slopes_that_face_a_lamp_are_brighter(rng):
    background = rng.uniform(0.3, 0.6, (120, 160, 3))
    assert render(np.zeros((120, 160)), SENSOR.pixel_pitch, background, Lamps.around()) == pytest.approx(background)
    # the red lamp stands where rows grow to: it lights what faces it, the near side of a dent not
    height = np.maximum(under_ball(0.8 * MM), 0)
    change = render(height, SENSOR.pixel_pitch, background, Lamps.around()) - background
    assert change[40:55, 75:85, 0].mean() < -0.02 < 0.02 < change[65:80, 75:85, 0].mean()


def test_a_rendered_tactile_image_gives_its_contact_back(rng):
    touched, height = elastic_contact(under_ball(0.9 * MM, (1.5 * MM, 0.5 * MM)), SENSOR.pixel_pitch)
    reading, background = (
        example_reading(h, SENSOR.pixel_pitch, 1 / 255, rng) for h in (height, np.zeros_like(height))
    )
    for method in CONTACT_METHODS:
        found = contact_mask(reading, background, SENSOR, method)
        offset = np.argwhere(found).mean(0) - np.argwhere(touched).mean(0)
        assert np.hypot(*offset) < 2 and 0.7 < found.sum() / touched.sum() < 2
        assert not contact_mask(background, background, SENSOR, method).any()


@pytest.mark.parametrize("n", slow_but((1, 6), 1))
def test_a_prior_on_the_depth_is_compared_with_the_whole_press(ball, rng, n):
    """A depth map is compared by a contour some height up; that contour's size does not measure how deep the ball lies."""
    for T in ball.space.sample(n, rng, (1.3 * MM, 1.6 * MM))[0]:
        height = ball.simulate(T).height
        evidence = []
        for off in (0.0, 0.75 * MM):  # as deep as it is, and as deep as the contour looks
            at = T.copy()
            at[2, 3] += off
            prior = GaussianPrior(at, np.diag([0.05**2] * 3 + [(0.1 * MM) ** 2] * 3))
            evidence.append(ball.localize(height, "height", prior=prior, effort=GRID_ALONE).log_evidence)
        assert evidence[0] > evidence[1] + 1


def test_simulated_tactile_images_are_localized_without_options(tmp_path):
    run = CliRunner().invoke(
        app, ["simulate", "hex_nut", "--sensor", "gelsight-mini", "--tactile-image", "--n", "1", "--out", str(tmp_path)]
    )
    assert run.exit_code == 0, run.output
    image, background = (read_image(tmp_path / name) for name in ("hex_nut_1.png", "background.png"))
    assert image.shape == background.shape == (240, 320, 3)
    assert read_observation(image, "gelsight-mini", background=background).contact.mask.any()


@pytest.mark.slow
def test_a_calibrated_sensor_identifies_the_real_ball_by_its_heights(data_folder, tmp_path, cache_dir, few_touches):
    """Every sixth press that lies wholly in the window; the calibration saw presses of the other ball alone."""
    folder = data_folder / "gelslam_gsmini_balls"
    found = calibrations(data_folder, cameras()["parallel rays"])
    sensors = {ball: each.sensor for ball, each in found.items()}
    assert all(0.01 * MM < sensor.height_noise < 0.05 * MM for sensor in sensors.values())
    assert all(0.5 * MM < sensor.height_correlation < 2 * MM for sensor in sensors.values())
    observation = read_observation(
        folder / "9.500mm" / "10.png", sensors[BALLS[0]], background=folder / "background.png"
    )
    assert observation.contact.height.max() == pytest.approx(0.8 * MM, abs=0.1 * MM)
    lines = CIRCLES.read_text("utf-8").splitlines()
    inside = [row["file"] for row in circles_of(CIRCLES) if row["inside"] == "1"][::6]
    some = tmp_path / "some.csv"
    some.write_text("\n".join(line for line in lines if line.startswith("file") or line.split(",")[0] in inside))
    pressed = list(localize_balls(data_folder, some, sensors, cache_dir))
    assert len(pressed) == 5
    assert np.mean([p.nats > 0 for p in pressed]) >= 0.8
    assert np.median([p.off_mm for p in pressed]) < 0.3


def test_the_height_noise_of_a_sensor_is_kept(tmp_path):
    mine = replace(SENSOR, height_noise=0.02 * MM, height_correlation=0.5 * MM)
    again = Sensor.from_toml(mine.to_toml())
    assert (again.height_noise, again.height_correlation) == pytest.approx((0.02 * MM, 0.5 * MM))
    usual = replace(SENSOR, height_noise=HEIGHT_NOISE)
    assert "height_" not in usual.to_toml() and mine.sha256 == usual.sha256


def test_the_farther_depths_correlate_the_less_they_say():
    """As many observations as areas of the correlation fit in, and at most one for each depth."""
    shares = [contact_likelihood._observations(replace(SENSOR, height_correlation=c * MM)) for c in (0.01, 1.0, 2.0)]
    assert shares[0] == 1 and shares[1] / shares[2] == pytest.approx(4)


def test_a_scan_is_read_with_its_pitch(data_folder):
    height, pitch = read_scan(data_folder / "gelsight_groove_scan" / "heightmap.tmd")
    assert height.shape == (514, 616) and pitch == pytest.approx((0.02746 * MM, 0.02746 * MM), rel=1e-3)
    assert 0.3 * MM < np.ptp(height) < 0.5 * MM


@pytest.mark.slow
def test_depths_take_nothing_away_from_what_the_mask_says(make_localizer, rng):
    """Twenty elastic touches of a plug, depths off by 0.02 mm over a millimetre: the gain is no smaller with them than by the
    contact found in them alone, but for chance, and the truth is where it is said to be."""
    sensor = replace(Sensor.load("gelslim"), height_noise=0.02 * MM)
    plug = make_localizer("connector_plug", sensor)
    pitch, gains, levels = np.sqrt(sensor.pixel_area(sensor.image_size_px[::-1])), [], []
    for touch in random_touches(plug.space, 20, 6, True):
        noise = cv2.GaussianBlur(rng.normal(size=sensor.image_size_px[::-1]), (0, 0), 1 * MM / pitch)
        height = simulate_depth_map(plug.space, touch.T_sensor_object) + 0.02 * MM * noise / noise.std()
        height = np.maximum(height, 0).astype(np.float32)
        both, mask = plug.localize(height, "height"), plug.localize(Contact.of_height(height).mask, "mask")
        gains.append([each.log_density(touch.T_sensor_object) for each in (both, mask)])
        levels.append(both.credible_level(touch.T_sensor_object))
    more = np.subtract(*np.transpose(gains))
    assert more.mean() > -2 * more.std() / np.sqrt(20), more
    assert np.mean(np.array(levels) < 0.9) >= 0.7
