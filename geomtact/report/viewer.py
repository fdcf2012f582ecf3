"""A live view in the browser: the sensor, its contact and the distribution of the object's pose (extra ``viz``)."""

from __future__ import annotations

import importlib.util
import socket
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geomtact.errors import UsageError
from geomtact.geometry.mesh import Mesh, coarser
from geomtact.report.canvas import COLOURS, rgb, to_pixels
from geomtact.report.turnable import outlines_of
from geomtact.se3 import Array, apply

if TYPE_CHECKING:
    from geomtact.inference.posterior import Posterior

_FACES = 3_000  # of the object, as it is drawn often
_POSES = 60  # of the posterior, that are drawn through one another
_FAINT = 0.06  # opacity of each
_CM = 100.0  # a unit of the scene is a centimetre
_LINES = 1.5  # pixels
_EVERY = "0.0.0.0"  # all addresses of this machine
_WINDOW, _CONTACT = (110, 110, 110), (20, 20, 20)


class Viewer:
    """A page that shows the last posterior it was given: the object at poses drawn from it, and at its first mode.

    Parameters
    ----------
    mesh : of the object
    host, port : where the page is served; the next free port, if this one is taken

    Raises
    ------
    UsageError
        As :func:`check_viewer`.
    """

    def __init__(self, mesh: Mesh, host: str = "127.0.0.1", port: int = 8080) -> None:
        check_viewer(host)
        import viser

        self._server = viser.ViserServer(host=host, port=port, label=f"geomtact: {mesh.name}", verbose=False)
        name = socket.gethostname() if host == _EVERY else host
        self.url = f"http://{name}:{self._server.get_port()}"
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._summary = self._server.gui.add_markdown("")
        self._image = self._server.gui.add_image(np.zeros((1, 1, 3), np.uint8), label="image")
        mesh = coarser(mesh, _FACES)
        shape = _CM * mesh.vertices, np.asarray(mesh.faces)
        colours = [np.round(255 * rgb(colour)).astype(int) for colour in COLOURS[:2]]
        scene = self._server.scene
        at = np.tile([1.0, 0, 0, 0], (_POSES, 1)), np.zeros((_POSES, 3))
        self._drawn = scene.add_batched_meshes_simple("/drawn", *shape, *at, batched_colors=colours[0], opacity=_FAINT)
        self._mode = scene.add_mesh_simple("/mode", *shape, color=colours[1])
        self._eye = mesh.diameter * np.array([0.4, -1.4, 0.8])  # in the sensor frame, for browsers that come
        self._rng = np.random.default_rng(0)

    def show(self, number: int, posterior: Posterior) -> None:
        """Show frame ``number``'s posterior."""
        contact, sensor, T = posterior.contact, posterior.sensor, posterior.T_frame_sensor
        scene, camera = self._server.scene, self._server.initial_camera
        camera.position, camera.look_at = _CM * apply(T, self._eye)[0], _CM * T[:3, 3]
        scene.add_line_segments(
            "/sensor", _around(_CM * apply(T, sensor.corners)), _WINDOW, thickness=_LINES, thickness_units="screen"
        )
        lines = [np.zeros((0, 2, 3))]
        picture = np.zeros((1, 1, 3), np.uint8)  # of a frame that could not be read
        seen = posterior.observation
        if seen is not None:
            lines += [_around(_CM * apply(T, line)) for line in outlines_of(seen.contact.mask, sensor)]
            picture = to_pixels(seen.contact.mask if seen.kind == "mask" else seen.image)
        self._image.image = picture
        scene.add_line_segments(
            "/contact", np.concatenate(lines), _CONTACT, thickness=2 * _LINES, thickness_units="screen"
        )
        modes = posterior.modes(1) if contact else []
        self._drawn.visible = self._mode.visible = bool(modes)
        summary = "no contact"
        if modes:
            some, first = posterior.sample(_POSES, self._rng), modes[0]
            self._drawn.batched_wxyzs = _wxyz(some)
            self._drawn.batched_positions = np.float32(_CM) * some[:, :3, 3].astype(np.float32)
            self._mode.wxyz, self._mode.position = _wxyz(first.T), _CM * first.T[:3, 3]
            gain = max(0.0, posterior.information_gain_nats)
            summary = f"mode 1: {100 * first.probability:.1f} %, information gain {gain:.1f} nats"
        self._summary.content = "\n\n".join(
            [f"**{posterior.mesh.name}, frame {number}**", summary, *posterior.warnings]
        )

    def stop(self) -> None:
        """Serve the page no longer."""
        self._server.stop()


def check_viewer(host: str) -> None:
    """Refuse to serve where viser or the address is missing, before any work is done.

    Raises
    ------
    UsageError
        Viser is not installed, or ``host`` is no address of this machine.
    """
    if importlib.util.find_spec("viser") is None:
        raise UsageError("the viewer needs viser; install it with: pip install 'geomtact[viz]'")
    try:
        with socket.create_server((host, 0)):
            pass
    except OSError as error:
        raise UsageError(
            f"--host {host}: no address of this machine ({error.strerror or error}); give 127.0.0.1, or 0.0.0.0 for all"
        ) from None


def _wxyz(T: Array) -> NDArray[np.float32]:
    """Unit quaternions (..., 4), w first, of ``T`` (..., 4, 4)."""
    return np.asarray(Rotation.from_matrix(T[..., :3, :3]).as_quat(scalar_first=True), np.float32)


def _around(line: Array) -> Array:
    """The segments (n, 2, 3) of the closed ``line`` (n, 3)."""
    return np.stack([line, np.roll(line, -1, 0)], 1)
