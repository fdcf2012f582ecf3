"""The gel under a ball as a camera sees it: the closed form equals rays cast at a mesh of the ball."""

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
def middle(sensor):
    """Of the imprint, (3,) on the membrane at rest: beside the window's middle, where a near camera looks askance."""
    x, y = 4.2 * MM, -1.9 * MM
    return np.array([x, y, -float(sensor.sag(x, y))])


@pytest.fixture
def centre(sensor, middle):
    """Of the ball, (3,): along the membrane's normal, so that both meet in a circle of the imprint's radius, which is the
    same in every viewing direction."""
    above, bend = np.sqrt(BALL**2 - IMPRINT**2), sensor.membrane_radius
    if not bend:
        return middle + [0, 0, above]
    inner = np.array([0, 0, -bend])
    normal = (middle - inner) / np.linalg.norm(middle - inner)
    return inner + normal * (np.sqrt(bend**2 - IMPRINT**2) + above)


@pytest.fixture
def on_ball(sensor, middle):
    none = np.zeros((*SHAPE, 3))
    size = 1 - middle[2] / sensor.camera_distance if sensor.camera_distance else 1.0  # as it is seen at z = 0
    at = sensor.to_pixels(sensor.project(middle))
    press = Press("made", none, none[..., 0] > 0, none[..., 0] > 0, at, IMPRINT / PITCH * size)
    return OnBall.within(press, sensor, 0.6)


@pytest.fixture
def depths(sensor, centre):
    """Of a mesh of the ball, (H, W) [m]."""
    ball = trimesh.creation.icosphere(subdivisions=6, radius=BALL)
    T = np.eye(4)
    T[:3, 3] = centre
    return Caster(ball.vertices, ball.faces).depths(sensor, T)[0]


def test_the_ball_lies_over_its_imprint_along_the_membranes_normal(on_ball, centre):
    assert on_ball.centre(BALL) == pytest.approx(centre, abs=0.01 * MM)


def test_heights_and_slopes_equal_those_of_traced_rays(on_ball, depths):
    assert on_ball.height(BALL) == pytest.approx(depths[on_ball.at], abs=5e-3 * MM)
    slopes = np.stack(np.gradient(np.maximum(depths, -1), PITCH)[::-1], -1)
    assert on_ball.slopes(BALL) == pytest.approx(slopes[on_ball.at], abs=0.01)


def test_the_diameter_of_its_own_slopes_is_the_balls(on_ball):
    for radius in (BALL, 1.5 * BALL):
        assert on_ball.diameter(on_ball.slopes(radius)) == pytest.approx(2 * radius, rel=1e-6)


def test_a_near_camera_sees_the_deepest_point_farther_out_than_the_imprints_middle(sensor, on_ball, depths):
    v, u = np.unravel_index(depths.argmax(), SHAPE)
    share = depths.max() / sensor.camera_distance if sensor.camera_distance else 0.0
    if not sensor.membrane_radius:
        apart = sensor.from_pixels(np.array([u, v])) - on_ball.middle[:2]
        assert apart == pytest.approx(share * on_ball.middle[:2], abs=0.7 * PITCH)


def test_what_does_not_dip_has_no_diameter(on_ball):
    assert np.isnan(on_ball.diameter(-on_ball.slopes(BALL))) and np.isnan(
        on_ball.diameter(np.zeros((len(on_ball.xy), 2)))
    )
