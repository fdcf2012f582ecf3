"""Images localized as they come: the newest wins, none waits, and what shows no contact is the background of the rest."""

import importlib
import json
import os
import threading
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from geomtact import InputError, Mesh, Sensor
from geomtact.cli.frames import Frame, all_frames, camera_frames, newest, newest_in
from geomtact.cli.live import localize_live
from geomtact.cli.shell import one_line_errors
from geomtact.sensing.image_file import write_image
from geomtact.sensing.render import example_reading

MINI = Sensor.load("gelsight-mini")


@pytest.fixture(scope="module")
def localizer(make_localizer):
    import trimesh

    box = trimesh.creation.box((8e-3, 6e-3, 5e-3))
    mesh = Mesh(box.vertices, box.faces, "box", "m")
    return make_localizer(mesh, MINI, max_poses=1500, scorer="iou")


def test_the_newest_image_wins_and_skipped_ones_are_counted():
    """A source of 40 images, of which 9 come while the first is worked on, and 20 more while the next one is."""
    may_read, has_read, numbers = threading.Semaphore(1), threading.Semaphore(0), count()

    def read():
        may_read.acquire()
        n = next(numbers)
        has_read.release()
        return n if n < 40 else None

    closed = []
    frames = newest(read, lambda: closed.append(True))

    def come(n):
        for _ in range(n):
            may_read.release()
        for _ in range(n):
            has_read.acquire()

    first = next(frames)
    has_read.acquire()
    assert (first.image, first.skipped) == (0, 0)
    come(9)
    given = [next(frames)]
    while given[-1].image < 9:  # the last may not have been put down yet
        given.append(next(frames))
    assert given[-1].image == 9 and sum(frame.skipped + 1 for frame in given) == 9 and len(given) <= 2
    come(20)
    while given[-1].image < 29:
        given.append(next(frames))
    assert len(given) <= 4, "none waits in a queue"
    for _ in range(11):
        may_read.release()
    rest = list(frames)
    assert rest[-1].image == 39 and closed == [True]
    images = [frame.image for frame in (first, *given, *rest)]
    assert images == sorted(set(images))
    assert sum(frame.skipped + 1 for frame in (first, *given, *rest)) == 40


def test_a_source_that_is_left_is_closed():
    closed = threading.Event()
    frames = newest(count().__next__, closed.set)
    next(frames)
    frames.close()
    assert closed.wait(10)


def test_a_folder_gives_its_newest_whole_image(tmp_path):
    for age, name in enumerate(("c.png", "a.png", "b.png")):
        write_image(tmp_path / name, np.ones((8, 8), bool))
        os.utime(tmp_path / name, (100 - age, 100 - age))
    frames = newest_in(tmp_path)
    first = next(frames)
    assert first.image == str(tmp_path / "c.png") and first.skipped == 2
    write_image(tmp_path / "d.png", np.ones((8, 8), bool))
    assert next(frames).image == str(tmp_path / "d.png"), "the older ones do not come again"
    write_image(tmp_path / "a.png", np.zeros((8, 8), bool))
    assert next(frames).image == str(tmp_path / "a.png"), "but one that is written anew does"


def test_a_folder_that_fills_faster_than_it_is_looked_at_is_not_waited_for(tmp_path):
    filled = threading.Event()

    def fill():
        for i in range(60):
            path = tmp_path / f"{i}.png"
            path.write_bytes(b"an image")
            (tmp_path / f"{i - 5}.png").unlink(missing_ok=True)
            if filled.wait(0.02):
                return

    writer = threading.Thread(target=fill)
    writer.start()
    frames = newest_in(tmp_path)
    numbers = [int(Path(next(frames).image).stem) for _ in range(5)]
    filled.set()
    writer.join()
    assert numbers == sorted(set(numbers)) and numbers[-1] < 60


def test_a_missing_camera_is_an_error():
    for open_it in (camera_frames, all_frames):
        with pytest.raises(InputError, match="camera 97: cannot be opened"):
            open_it("97")


@pytest.fixture(scope="module")
def readings(localizer):
    """Two touches as a camera sees them, and that camera's background."""
    rng = np.random.default_rng(3)
    T = localizer.space.sample(40, rng, (8e-4, 1.2e-3))[0]
    masks = localizer.space.caster.depths(MINI, T, (48, 64)) > 0
    large = np.argsort([-mask.mean() if not _cut(mask) else 0 for mask in masks])[:2]
    depths = [np.maximum(localizer.space.caster.depths(MINI, T[i][None], (240, 320))[0], 0) for i in large]
    return [example_reading(depth, MINI.pixel_pitch, 1 / 255, rng) for depth in (*depths, np.zeros((240, 320)))]


def _cut(mask):
    return mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()


def live(images):
    yield from (Frame(image) for image in images)


def test_the_first_without_contact_is_the_background_of_the_rest(localizer, readings, capsys):
    one, other, empty = readings
    seen = []

    class Spy:
        def localize(self, image, background, **options):
            seen.append(background)
            return localizer.localize(image, background=background, **options)

    options = {"kind": "reading", "effort": "fast"}
    assert localize_live(Spy(), live([empty, one, empty + np.uint8(1), other]), None, options)
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["contact"] for line in lines] == [False, True, False, True]
    assert seen[0] is None and all(np.array_equal(background, empty) for background in seen[1:])
    seen.clear()
    localize_live(Spy(), live([empty, one]), empty, options)
    assert seen == [empty, empty], "a given one is kept"


def test_an_image_that_is_broken_is_skipped_but_the_first_is_not(localizer, capsys):
    whole = np.zeros((240, 320), bool)
    whole[100:140, 100:160] = True
    broken = np.zeros((3, 3))
    with pytest.raises(InputError):
        localize_live(localizer, live([broken, whole]), None, {"effort": "fast"})
    assert localize_live(localizer, live([whole, broken, whole]), None, {"effort": "fast"})
    out, err = capsys.readouterr()
    lines = [json.loads(line) for line in out.splitlines()]
    assert [line["frame"] for line in lines] == [1, 3] and "image 2 skipped" in err
    assert lines[0]["T"] == lines[1]["T"], "each image is localized by itself"


def test_the_command_line(localizer, readings, monkeypatch, tmp_path):
    module = importlib.import_module("geomtact.cli.localize")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("geomtact.cli.request.Request.open", lambda *_, **__: localizer)
    app = typer.Typer()
    app.command()(one_line_errors(module.localize))

    def run(*args):
        result = CliRunner().invoke(app, [*(str(a) for a in args), "--effort", "fast"])
        return result.exit_code, result.stdout, " ".join(result.output.split())

    video = cv2.VideoWriter("film.avi", cv2.VideoWriter_fourcc(*"MJPG"), 10, (320, 240))
    for image in (readings[2], readings[0], readings[0]):
        video.write(np.ascontiguousarray(image[..., ::-1]))
    video.release()
    status, out, _ = run("--camera", "film.avi")
    lines = [json.loads(line) for line in out.splitlines()]
    assert status == (0 if any(line["contact"] for line in lines) else 4)
    assert sum(line["skipped"] + 1 for line in lines) == 3

    for args, said in (
        ((), "expected an image, got none"),
        (("film.avi", "--camera", "0"), "--camera replaces images"),
        (("--watch",), "--watch: expected one folder, got 0"),
        ((".", "--watch", "--json"), "--json excludes --camera and --watch"),
    ):
        status, _, text = run(*args)
        assert status == 2 and said in text
    status, _, text = run("film.avi", "--watch")
    assert status == 3 and "--watch film.avi: expected the folder" in text
    status, _, text = run(".")
    assert status == 3 and "use --watch for the newest" in text
