"""The examples run unchanged in an empty folder, and reach the figures of their pages."""

import json
import re
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from PIL import Image

from geomtact import Localizer
from geomtact.sensing.render import example_reading

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "docs" / "examples"


@pytest.fixture
def example(tmp_path, cache_dir, few_touches, monkeypatch, capsys):
    """Runs an example as the command line would, with a score fitted on few touches; what it prints."""

    def run(name, *words):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("GEOMTACT_CACHE", str(cache_dir))
        monkeypatch.setattr(sys, "argv", [name, *words])
        runpy.run_path(str(ROOT / name), run_name="__main__")
        return capsys.readouterr().out

    return run


@pytest.mark.slow
def test_touch_until_sure(example):
    last = [line for line in example("docs/examples/touch_until_sure.py").splitlines() if "mm off the truth" in line][
        -1
    ]
    held, off = float(last.split("holds ")[1].split(" %")[0]), float(last.split("it is ")[1].split(" mm")[0])
    assert held >= 90 and off < 5


@pytest.mark.slow
def test_the_pencils_ends_constrain_most(example, tmp_path):
    """A touch of its middle does not constrain which end lies where; one of its ends does."""
    said = example("docs/examples/pencil.py").splitlines()
    ranked = [line[:24].strip() for line in said if "discards" in line]
    assert len(ranked) == 7 and "end" in ranked[0] and ranked[0] != "finger in the middle"
    assert (tmp_path / "out" / "pencil" / "next_touch.png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_gripper_that_reads_its_width(example):
    said = example("docs/examples/gripper.py", "--part", "connector_plug", "--max-poses", "60000")
    assert float(re.search(r"at the true pose: (\S+) nats", said)[1]) > 0
    assert re.search(r"the jaw is \d+\.\d mm open", said)


@pytest.mark.slow
def test_a_face_put_down_flat_is_localized_with_known_and_unknown_contact_face(example):
    said = example("docs/examples/face_on.py", "--max-poses", "20000", "--touches", "6", "--tilt", "1").splitlines()
    assert len(said) == 2 and "any side" in said[0] and "that side" in said[1]
    for line in said:
        assert float(re.search(r"(\S+) nats told", line)[1]) > 2 and " 0 % outside the 99 % region" in line


@pytest.mark.studies
def test_kitting_places_nothing_that_it_is_not_sure_of(example, tmp_path):
    """One touch of a plug leaves more than a millimetre open."""
    said = example(
        "tools/studies/kitting/film.py", "--part", "connector_plug", "--max-poses", "20000", "--touches", "1"
    )
    assert re.search(r"touch 1: \d+\.\d nats gained, it fits with \d+ %", said) and "not sure, not placed" in said
    with Image.open(tmp_path / "out" / "kitting" / "connector_plug.gif") as film:
        assert film.n_frames > 5


@pytest.mark.studies
def test_a_figure_of_the_thesis_shows_the_distances_that_it_names(example, tmp_path):
    example("tools/studies/thesis/figures.py", "10")
    figure = json.loads((tmp_path / "out" / "thesis" / "thesis_figures.json").read_text())["10"]
    for each in figure["shown"]:
        assert each["add_mm"] == pytest.approx(each["normalised"] * figure["random_mm"], rel=1e-3)
    assert (tmp_path / "out" / "thesis" / "thesis_errors.png").stat().st_size > 10_000


def test_the_ros_node_sends_the_first_mode_in_the_images_frame(ball, monkeypatch, rng):
    """ROS itself is stood in for: the node sees the untouched gel, a press, and an image of another size."""
    pressed = ball.simulate(ball.space.sample(1, rng, (8e-4, 1e-3))[0][0]).height
    images = [example_reading(height, ball.sensor.pixel_pitch, 0.0, rng) for height in (0 * pressed, pressed)]
    images.append(images[1][:-2])
    published, warned = [], []

    class Node:
        def __init__(self, name):
            assert name == "geomtact"

        def declare_parameter(self, name, value):
            return SimpleNamespace(value=value)

        def create_publisher(self, kind, topic, depth):
            return SimpleNamespace(publish=published.append)

        def create_subscription(self, kind, topic, seen, depth):
            pass

        def get_logger(self):
            return SimpleNamespace(info=lambda line: None, warning=warned.append)

    def spin(node):
        for image in images:
            node.seen(SimpleNamespace(header=SimpleNamespace(frame_id="gel"), image=image))

    parts = {
        "rclpy": {"init": lambda: None, "spin": spin},
        "rclpy.node": {"Node": Node},
        "cv_bridge": {"CvBridge": lambda: SimpleNamespace(imgmsg_to_cv2=lambda message, encoding: message.image)},
        "geometry_msgs.msg": {"PoseWithCovarianceStamped": lambda header: MagicMock(header=header)},
        "sensor_msgs.msg": {"Image": object},
    }
    for name, held in parts.items():
        module = ModuleType(name)
        module.__dict__.update(held)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(Localizer, "prepare", lambda part, sensor: ball)
    runpy.run_path(str(EXAMPLES / "ros2_node.py"))

    (message,) = published
    mode = ball.localize(images[1], kind="reading", background=images[0]).modes(1)[0]
    position = message.pose.pose.position
    np.testing.assert_allclose([position.x, position.y, position.z], mode.T[:3, 3])
    assert message.header.frame_id == "gel" and np.shape(message.pose.covariance) == (36,)
    assert len(warned) == 1 and "px" in warned[0]
