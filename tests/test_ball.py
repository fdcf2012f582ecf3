"""The gel under a ball as a camera sees it: what rays cast at a mesh of the ball say, too."""

import numpy as np
import pytest
import trimesh

from geomtact import Sensor
from geomtact.sensing.ball import OnBall
from geomtact.sensing.cast import Caster
from geomtact.sensing.press import Press

MM = 1e-3
SHAPE, PITCH, BALL, IMPRINT = (120, 160), 0.1 * MM, 3 * MM, 1.8 * MM
CAMERAS = {"straight": (0.0, 0.0), "near": (20 * MM, 0.0), "bulging": (0.0, 35 * MM), "both": (20 * MM, 35 * MM)}


@pytest.fixture(params=CAMERAS)
def sensor(request):
    distance, bend = CAMERAS[request.param]
    return Sensor("made", SHAPE[::-1], (PITCH, PITCH), distance, 2 * MM, membrane_radius=bend)


@pytest.fixture
def on_ball(sensor):
    """Beside the window's middle, where a near camera looks askance."""
    none = np.zeros((*SHAPE, 3))
    press = Press("made", none, none[..., 0] > 0, none[..., 0] > 0, np.array([122.3, 41.0]), IMPRINT / PITCH)
    return OnBall.within(press, sensor, 0.6)


@pytest.fixture
def depths(sensor, on_ball):
    """Of a mesh of the ball, (H, W) [m]: its middle over the imprint's, so deep that it would cut the membrane at the imprint."""
    ball = trimesh.creation.icosphere(subdivisions=6, radius=BALL)
    T = np.eye(4)
    T[:2, 3] = on_ball.centre
    T[2, 3] = np.sqrt(BALL**2 - on_ball.imprint**2) - sensor.sag(*on_ball.centre)
    return Caster(ball.vertices, ball.faces).depths(sensor, T)[0]


def test_heights_and_slopes_are_those_that_rays_find(on_ball, depths):
    assert on_ball.height(BALL) == pytest.approx(depths[on_ball.at], abs=1e-3 * MM)
    slopes = np.stack(np.gradient(np.maximum(depths, -1), PITCH)[::-1], -1)
    assert on_ball.slopes(BALL) == pytest.approx(slopes[on_ball.at], abs=0.01)


def test_the_diameter_of_its_own_slopes_is_the_balls(on_ball):
    for radius in (BALL, 1.5 * BALL):
        assert on_ball.diameter(on_ball.slopes(radius)) == pytest.approx(2 * radius, rel=1e-6)


def test_a_near_camera_sees_the_deepest_point_farther_out_than_the_imprints_middle(sensor, on_ball, depths):
    v, u = np.unravel_index(depths.argmax(), SHAPE)
    apart = sensor.from_pixels(np.array([u, v])) - on_ball.centre
    share = depths.max() / sensor.camera_distance if sensor.camera_distance else 0.0
    if not sensor.membrane_radius:
        assert apart == pytest.approx(share * on_ball.centre, abs=0.7 * PITCH)
