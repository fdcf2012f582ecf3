"""Fixtures shared by all tests."""

import os
from pathlib import Path

import numpy as np
import pytest
from speed import slow_but


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real tactile images and meshes; tests that need it are skipped where it is not given."""
    folder = os.environ.get("GEOMTACT_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("set GEOMTACT_DATA to the folder of real readings")
    return Path(folder).resolve()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


CURVED_SENSOR = """
name = "curved"
image_size_px = [240, 320]
pixel_pitch_mm = [0.05, 0.05]
camera_distance_mm = 20.0
max_penetration_mm = 2.0
membrane_radius_mm = 30.0
"""


@pytest.fixture(scope="session")
def cache_dir(tmp_path_factory) -> Path:
    """A cache of indexes that all tests share, those of other pytest-xdist workers too."""
    if os.environ.get("PYTEST_XDIST_WORKER"):
        return tmp_path_factory.getbasetemp().parent / "geomtact-cache"
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="session")
def make_localizer(cache_dir):
    """Localizers on small grids, their score fitted on few touches: what is tested here holds for any."""
    from geomtact import Localizer
    from geomtact.scoring import fitted

    def make(mesh, sensor, approach=None, max_poses=20_000, touches=60, **options):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(fitted, "TOUCHES", touches)
            options = {"cache_dir": cache_dir, **options}
            return Localizer.prepare(mesh, sensor=sensor, approach=approach, max_poses=max_poses, **options)

    return make


@pytest.fixture(scope="module")
def few_touches():
    """Scores are fitted on few touches in what a module prepares."""
    from geomtact.scoring import fitted

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fitted, "TOUCHES", 60)
        yield


@pytest.fixture(scope="session")
def curved_sensor():
    from geomtact import Sensor

    return Sensor.from_toml(CURVED_SENSOR)


@pytest.fixture(scope="session")
def plug(make_localizer):
    """An object without symmetry."""
    return make_localizer("connector_plug", "gelslim", touches=240)


@pytest.fixture(scope="session")
def pin(make_localizer):
    """A body of revolution, 100 mm long."""
    return make_localizer("damping_pin", "gelslim")


@pytest.fixture(scope="session")
def ball(make_localizer):
    return make_localizer("ball", "gelsight-mini")


@pytest.fixture(scope="session")
def curved(make_localizer, curved_sensor):
    """A nut, which twelve rotations map onto itself, on a membrane that bulges."""
    return make_localizer("hex_nut", curved_sensor)


@pytest.fixture(scope="session")
def flat_nut(make_localizer):
    """A nut that lies on its flat face: only x, y, depth and a sixth of a turn are unknown."""
    return make_localizer("hex_nut", "gelsight-mini", approach=[((0, 0, 1), 0.0)])


@pytest.fixture(scope="session")
def cone(make_localizer):
    """A bracket touched from above, more or less."""
    return make_localizer("bracket", "gelslim", approach=[((0, 0, 1), 0.5), ((0, 0.3, 1), 0.5)])


LOCALIZERS = ("plug", "pin", "ball", "curved", "flat_nut", "cone")


# an object without symmetry that may touch anyhow, and a symmetric one whose face and housing leave little
@pytest.fixture(params=slow_but(LOCALIZERS, "plug", "flat_nut"))
def localizer(request):
    """Each of the localizers in turn."""
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="session")
def uniform_poses():
    """Poses uniform over a localizer's contact pose space and their penetrations: (200, 4, 4) and (200,) [m]."""
    drawn: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def draw(localizer):
        key = localizer.index.key
        if key not in drawn:
            drawn[key] = localizer.space.sample(200, np.random.default_rng(1))
        return drawn[key]

    return draw


@pytest.fixture(scope="session")
def a_touch():
    """A touch of a localizer's object at a pose that the grid does not hold: its pose (4, 4) and its mask (H, W)."""
    touches: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def touch(localizer):
        key = localizer.index.key
        if key not in touches:
            T, _ = localizer.space.sample(40, np.random.default_rng(2), (0.8e-3, 1.2e-3))
            masks = [localizer.simulate(pose).mask for pose in T]
            area = np.array([m.sum() for m in masks])
            # a contact of middling size, so that it lies inside the window
            chosen = int(np.argsort(area)[len(area) * 2 // 3])
            touches[key] = T[chosen], masks[chosen]
        return touches[key]

    return touch
