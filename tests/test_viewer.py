"""Laws of the live view: it shows the object at the poses of the posterior, and is served to a browser."""

import importlib
import importlib.util
import urllib.request

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from geomtact.cli import app
from geomtact.errors import UsageError
from geomtact.report import viewer
from geomtact.report.canvas import to_pixels
from geomtact.report.viewer import Viewer
from geomtact.se3 import transform
from geomtact.sensing.image_file import write_image

pytest.importorskip("viser")


@pytest.fixture
def shown(flat_nut):
    view = Viewer(flat_nut.mesh, port=8421)
    yield view
    view.stop()


def test_the_page_is_served(shown):
    with urllib.request.urlopen(shown.url, timeout=10) as page:
        assert page.status == 200 and b"<html" in page.read()


def test_the_object_is_drawn_at_the_pose_of_the_posterior(shown, flat_nut, a_touch):
    """In the posterior's frame, of which a unit of the scene is a centimetre: the first mode where it is, the others where poses
    drawn by the same seed lie."""
    T, mask = a_touch(flat_nut)
    T_world_sensor = transform(Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix(), np.array([0.2, 0.1, 0.5]))
    posterior = flat_nut.localize(mask, "mask", T_world_sensor=T_world_sensor)
    shown.show(1, posterior)
    (mode,) = posterior.modes(1)
    assert np.allclose(shown._mode.position, 100 * mode.T[:3, 3], atol=1e-4)
    assert np.allclose(Rotation.from_quat(shown._mode.wxyz, scalar_first=True).as_matrix(), mode.T[:3, :3], atol=1e-5)
    drawn = posterior.sample(viewer._POSES, np.random.default_rng(0))
    assert np.allclose(shown._drawn.batched_positions, 100 * drawn[:, :3, 3], atol=1e-3)
    turned = Rotation.from_quat(shown._drawn.batched_wxyzs, scalar_first=True).as_matrix()
    assert np.allclose(turned, drawn[:, :3, :3], atol=1e-5)
    assert shown._drawn.visible and shown._mode.visible
    assert "frame 1" in shown._summary.content


def test_without_contact_no_object_is_drawn(shown, flat_nut):
    width, height = flat_nut.sensor.image_size_px
    shown.show(2, flat_nut.localize(np.zeros((height, width), bool), "mask"))
    assert not shown._drawn.visible and not shown._mode.visible
    assert "no contact" in shown._summary.content


def test_images_of_every_kind_can_be_shown():
    mask = np.array([[True, False], [False, False]])
    assert np.array_equal(to_pixels(mask)[..., 0], [[255, 0], [0, 0]])
    assert (to_pixels(np.ones((2, 2), bool)) == 255).all()
    assert to_pixels(np.linspace(0, 1e-3, 6).reshape(2, 3)).shape == (2, 3, 3)
    assert not to_pixels(np.zeros((2, 2))).any()
    colour = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    assert np.array_equal(to_pixels(colour), colour)


def test_without_viser_the_error_names_the_install_command(flat_nut, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"geomtact\[viz\]"):
        Viewer(flat_nut.mesh)


def test_an_address_of_another_machine_is_refused(flat_nut):
    with pytest.raises(UsageError, match="--host 203.0.113.7: no address of this machine"):
        Viewer(flat_nut.mesh, "203.0.113.7")


def test_a_mask_of_zeros_and_ones_is_shown_white_on_black(shown, flat_nut, a_touch):
    _, mask = a_touch(flat_nut)
    shown.show(1, flat_nut.localize(mask.astype(np.uint8), "mask"))
    assert np.array_equal(shown._image.image[..., 0] == 255, mask) and not shown._image.image[~mask].any()


def test_the_command_shows_every_image(flat_nut, a_touch, tmp_path, monkeypatch, cache_dir):
    seen = []
    monkeypatch.setattr(Viewer, "show", lambda self, n, posterior: seen.append((n, posterior.contact)))
    monkeypatch.setattr("geomtact.cli.request.Request.open", lambda *_, **__: flat_nut)
    width, height = flat_nut.sensor.image_size_px
    write_image(tmp_path / "0.png", np.zeros((height, width), bool))
    words = [
        "view",
        str(tmp_path),
        "--object",
        "hex_nut",
        "--sensor",
        "gelsight-mini",
        "--kind",
        "mask",
        "--no-stay",
        "--port",
        "8422",
    ]
    untouched = CliRunner().invoke(app, words)
    assert untouched.exit_code == 4 and "no contact" in untouched.output
    write_image(tmp_path / "1.png", a_touch(flat_nut)[1])
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert seen == [(1, False), (1, False), (2, True)]
    assert "http://127.0.0.1:" in done.output
