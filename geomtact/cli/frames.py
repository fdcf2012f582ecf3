"""Sources of image sequences: folders, videos, cameras, paths on standard input; all images in order, or the newest."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from itertools import chain, starmap
from pathlib import Path
from typing import TYPE_CHECKING

from geomtact.cli.frame_order import doubt, in_order
from geomtact.cli.shell import to_stderr
from geomtact.errors import InputError, UsageError
from geomtact.files import printable

if TYPE_CHECKING:
    import cv2
    import numpy as np
    from numpy.typing import NDArray

    from geomtact.sensing.image_file import ImageFile
    from geomtact.sensing.reading import Observation
    from geomtact.sensing.sensor import Sensor

    Pixels = NDArray[np.generic]  # (H, W, 3) RGB, or a mask (H, W)
    Unread = str | ImageFile | Pixels
    Image = Unread | Observation

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".npy")
State = tuple[int, int]  # when a file was last written to [ns], and its size
_POLL = 0.05  # s between looks into a folder that is being filled


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a sequence.

    Attributes
    ----------
    image : path, (H, W, 3) RGB, or the Observation that it was read as
    time : [s] of a video, or since 1970 from a camera; None where the source has none
    skipped : images that came since the one before, and are not given
    """

    image: Image
    time: float | None = None
    skipped: int = 0


def all_frames(
    source: str,
    follow: bool = False,
    sensor: Sensor | None = None,
    read: Callable[[Unread], Image] = lambda image: image,
    masks: bool = False,
) -> Iterator[Frame]:
    """The frames of a folder, a video, a camera or, for -, of paths on standard input, in order; a camera's newest.

    ``follow`` waits for more images in a folder; ``sensor`` is as of :func:`camera_frames`; ``read`` reads the first image of a
    folder or a video at once, so that a bad one is reported early; ``masks`` says that a video is of contact masks: what is over
    half bright in it counts as contact.
    Names that leave the order of a folder's images open bring a warning.

    Raises
    ------
    UsageError, InputError
        At once, where it is no source of frames.
    """
    path = Path(source)
    if source == "-":
        return _named()
    if path.is_dir():
        images = listed(path)
        if not images and not follow:
            raise InputError(f"{path}: no image in this folder; expected {', '.join(_IMAGES)}")
        if (open_question := doubt(images)) is not None:
            to_stderr(f"warning: {path}: {open_question}")
        frames = _followed(path) if follow else (Frame(str(image)) for image in images)
        if not images:
            return frames
        first, image = str(images[0]), read(str(images[0]))
        return (Frame(image) if frame.image == first else frame for frame in frames)
    if path.is_char_device() or (source.isdigit() and not path.exists()):
        return camera_frames(source, sensor)
    if not path.is_file():
        raise InputError(
            f"{path}: no such folder, video or camera; give a folder of images, a video, the number of a camera, or -"
        )
    if path.suffix.lower() in _IMAGES:
        raise UsageError(f"{path}: is one image; give its folder, or use 'geomtact localize'")
    filmed = _filmed(path, masks)
    start = next(filmed, None)
    if start is None:
        raise InputError(f"{path}: no image in this video; give another, or a folder of images")
    return chain([Frame(read(start[0]), start[1])], starmap(Frame, filmed))


def listed(folder: Path) -> list[Path]:
    """The images in a folder, :func:`in_order`."""
    return in_order(_images_in(folder))


def newest_in(folder: Path) -> Generator[Frame, None, None]:
    """The newest whole image of a folder, then the newest of those that have been written into it meanwhile, or written anew,
    for ever."""
    given: dict[Path, State] = {}
    before: dict[Path, State] = {}
    while True:
        now = {path: state for path in _images_in(folder) if (state := _state(path))}
        came = sorted((path for path in now if now[path] != given.get(path)), key=lambda path: (now[path], path.name))
        whole = [i for i, path in enumerate(came) if now[path] == before.get(path)]
        before = now
        if whole:
            given.update((path, now[path]) for path in came[: whole[-1] + 1])
            yield Frame(str(came[whole[-1]]), skipped=whole[-1])
        else:
            time.sleep(_POLL)


def camera_frames(source: str, sensor: Sensor | None = None) -> Generator[Frame, None, None]:
    """The newest frame of a camera each time it is asked for, until there are no more; none waits in a queue.

    Parameters
    ----------
    source : number of the camera, its device, or a URL
    sensor : whose size of image the camera is asked for; what comes straight from the camera is turned as the maker's driver
        does, and its border is cut off

    Raises
    ------
    InputError
        The camera cannot be opened, gives no image, or (ImageError) one of another size than the sensor's.
    """
    import cv2

    size = None if sensor is None or sensor.border_fraction else sensor.camera_size_px
    if size is not None and sensor is not None and sensor.driver_rotation_deg in (90, 270):
        size = size[::-1]
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    capture = cv2.VideoCapture(int(source) if source.isdigit() else _name_for_opencv(source))
    if not capture.isOpened():
        raise InputError(
            f"camera {source}: cannot be opened; give the number of a camera on this computer, its device, or a URL"
        )
    if size is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])

    first = [_next_rgb(capture)]
    if first[0] is None:
        raise InputError(f"camera {source}: no image; close other programs that use it")
    if sensor is not None:
        _check_camera(first[0], sensor, source)

    def read() -> Pixels | None:
        image = first.pop() if first else _next_rgb(capture)
        return image if image is None or sensor is None else sensor.driven(image)

    return newest(read, capture.release)


def _check_camera(image: Pixels, sensor: Sensor, source: str) -> None:
    """Refuse a camera's image (H, W, 3) of another size than the sensor's; report whether it is turned."""
    from geomtact.sensing.change import check_size

    check_size(sensor.upright(sensor.driven(image)), sensor, f"camera {source}")
    if sensor.straight_from_camera(image):
        to_stderr(
            f"camera {source}: turning {image.shape[1]} x {image.shape[0]} px by {sensor.driver_rotation_deg} degrees "
            f"counter-clockwise, as the driver of {sensor.name} does"
        )


def newest(read: Callable[[], Pixels | None], close: Callable[[], None] = lambda: None) -> Generator[Frame, None, None]:
    """What ``read`` gave last, whenever the next frame is asked for, until it gives None; meanwhile it is called again and again.
    At last ``close`` is called."""
    held: deque[tuple[Pixels, float]] = deque(maxlen=1)
    changed, ended, came, given = threading.Condition(), False, 0, 0

    def keep_reading() -> None:
        nonlocal ended, came
        try:
            while not ended and (image := read()) is not None:
                with changed:
                    held.append((image, time.time()))
                    came += 1
                    changed.notify()
        finally:
            with changed:
                ended = True
                changed.notify()
            close()

    reader = threading.Thread(target=keep_reading, daemon=True)
    reader.start()
    try:
        while True:
            with changed:
                changed.wait_for(lambda: held or ended)
                if not held:
                    return
                (image, read_at), skipped, given = held.pop(), came - given - 1, came
            yield Frame(image, read_at, skipped)
    finally:
        ended = True
        reader.join(2)  # else it would be within OpenCV still when Python ends


def _images_in(folder: Path) -> Iterator[Path]:
    """The images in a folder, in no order."""
    return (path for path in folder.iterdir() if path.suffix.lower() in _IMAGES and not path.name.startswith("."))


def _state(path: Path) -> State | None:
    """What changes while a file is written; None of one that is empty, or has gone."""
    try:
        stat = path.stat()
    except FileNotFoundError:
        return None
    return (stat.st_mtime_ns, stat.st_size) if stat.st_size else None


def _followed(folder: Path) -> Iterator[Frame]:
    """The images of a folder and those that are written into it, for ever; each once it has stopped growing."""
    seen: set[Path] = set()
    before: dict[Path, State | None] = {}
    while True:
        for path in listed(folder):
            if path in seen:
                continue
            state = _state(path)
            if state is None or before.get(path) != state:
                before[path] = state
                break  # the images after it wait, so that their order is kept
            seen.add(path)
            yield Frame(str(path))
        time.sleep(_POLL)


def _named() -> Iterator[Frame]:
    """The images named by standard input, a line each."""
    import sys

    for line in sys.stdin:
        if line.strip():
            yield Frame(line.strip())


def _filmed(path: Path, masks: bool) -> Iterator[tuple[Pixels, float]]:
    """The images of a video (H, W, 3) RGB, or the ``masks`` (H, W) in them, where they are nearly black and white; and their
    times [s]."""
    import cv2

    from geomtact.sensing.drawn import bright_half

    video = cv2.VideoCapture(_name_for_opencv(str(path)))
    if not video.isOpened():
        raise InputError(f"{path}: OpenCV cannot read this video; give another, or a folder of images")

    def frames() -> Iterator[tuple[Pixels, float]]:
        while (image := _next_rgb(video)) is not None:
            half = bright_half(image) if masks else None
            yield image if half is None else half, 1e-3 * video.get(cv2.CAP_PROP_POS_MSEC)
        video.release()

    return frames()


def _name_for_opencv(name: str) -> str:
    """``name``, unless it is no UTF-8, at which OpenCV 5.0 crashes.

    Raises
    ------
    InputError
    """
    if name != printable(name):
        raise InputError(f"{name}: the name of a video must be UTF-8; rename it")
    return name


def _next_rgb(capture: cv2.VideoCapture) -> Pixels | None:
    """The next image (H, W, 3) of an OpenCV capture, or None."""
    ok, image = capture.read()
    return image[..., ::-1] if ok else None
