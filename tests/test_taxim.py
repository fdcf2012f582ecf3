"""Taxim's colour tables: used as the colours of a sensor, they give the slopes whose colours they show."""

import numpy as np
import pytest
from typer.testing import CliRunner

from geomtact import Sensor, SensorError
from geomtact.cli import app
from geomtact.sensing.ball import diameter_of
from geomtact.sensing.image_file import write_image
from geomtact.sensing.taxim import change_of, colours_of_taxim, read_table

BINS = 61
SHAPE = (60, 80)
LAMPS = np.array([[60.0, 5.0], [-30.0, 50.0], [-25.0, -45.0]])  # RGB of a slope of one along columns and along rows


@pytest.fixture
def table(tmp_path):
    """Of three lamps, of which each gets stronger towards the right."""
    middle = (np.arange(BINS) + 0.5) / (BINS - 1)
    steep, towards = np.tan(np.minimum(middle * np.pi / 2, 1.4)), 2 * np.pi * middle - np.pi
    slope = steep[:, None, None] * np.stack([np.cos(towards), np.sin(towards)], -1)
    seen = slope @ LAMPS.T
    place = np.zeros((BINS, BINS, 3, 6))
    place[..., 5], place[..., 3] = seen, 0.3 * seen / SHAPE[1]
    path = tmp_path / "polycalib.npz"
    blue_first = {name: place[:, :, 2 - k] for k, name in enumerate(("grad_r", "grad_g", "grad_b"))}
    np.savez(path, bins=BINS, **blue_first)
    return path


def test_a_table_shows_red_for_slopes_that_face_the_red_lamp(table):
    found = change_of(read_table(table), np.array([[0.2, 0.0], [0.0, 0.2]]), np.zeros(2), np.zeros(2))
    assert found == pytest.approx(0.2 * LAMPS.T / 255, abs=0.01)


def test_slopes_come_out_as_they_went_in(table, rng):
    colours = colours_of_taxim(table, SHAPE)
    slope = rng.uniform(-0.35, 0.35, (SHAPE[0] * SHAPE[1], 2))
    v, u = (each.ravel().astype(float) for each in np.indices(SHAPE))
    change = change_of(read_table(table), slope, u, v)
    found = colours.slopes(change.reshape(*SHAPE, 3)).reshape(-1, 2)
    assert np.sqrt(((found - slope) ** 2).mean()) < 0.03  # a bin is 1.5 degrees steep and 6 wide
    assert colours.slope_rms < 0.03


@pytest.mark.parametrize(("name", "shape", "pitch"), [("", (480, 640), 0.03e-3), ("digit", (320, 240), 0.05e-3)])
def test_a_ball_seen_through_the_makers_tables_has_its_size(data_folder, name, shape, pitch):
    path = data_folder / "taxim_calib" / name / "polycalib.npz"
    table, colours = read_table(path), colours_of_taxim(path, shape)
    diameters = []
    for at in ((0.5, 0.5), (0.3, 0.35), (0.7, 0.6)):
        v, u = (each.astype(float) for each in np.indices(shape))
        off = pitch * np.stack([u - at[0] * shape[1], v - at[1] * shape[0]], -1)
        on = np.linalg.norm(off, axis=-1) < 1e-3
        slope = -off[on] / np.sqrt((3e-3) ** 2 - (off[on] ** 2).sum(-1, keepdims=True))
        change = np.zeros((*shape, 3))
        change[on] = change_of(table, slope, u[on], v[on]) - change_of(table, 0 * slope, u[on], v[on])
        diameters.append(diameter_of(off[on], colours.slopes(change)[on]))
    assert diameters == pytest.approx(np.full(3, 6e-3), rel=0.12)


def test_the_command_makes_a_sensor_of_a_table(table, tmp_path):
    background = tmp_path / "background.png"
    write_image(background, np.full((*SHAPE, 3), 120, np.uint8))

    def run(*words):
        words_given = ["calibrate", table, "--background", background, "--out", tmp_path / "mine.toml", *words]
        return CliRunner().invoke(app, [str(word) for word in words_given])

    done = run("--pitch-mm", 0.1, 0.1)
    assert done.exit_code == 0, done.output
    sensor = Sensor.load(tmp_path / "mine.toml")
    assert sensor.image_size_px == SHAPE[::-1] and sensor.colour is not None
    assert "has no pitch" in run().output
    assert "needs no presses" in run("--ball-mm", 6).output
    assert "expected 240 x 320 px for sensor digit (width x height), got 80 x 60 px" in run("--sensor", "digit").output
    (tmp_path / "polycalib.npz").write_bytes(b"no table")
    assert run("--pitch-mm", 0.1, 0.1).exit_code == 3
    np.savez(table, bins=3, grad_r=np.zeros((2, 3, 6)), grad_g=np.zeros((2, 3, 6)), grad_b=np.zeros((2, 3, 6)))
    with pytest.raises(SensorError, match="expected three finite tables"):
        read_table(table)
