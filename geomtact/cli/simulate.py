"""``geomtact simulate``: touches of an object at known poses, as images that carry their object and sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geomtact.cli.options import Seed, SensorName, Unit
from geomtact.cli.shell import check_folder, note_overwritten, to_stderr
from geomtact.errors import InputError, UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from geomtact.contact_space.space import ContactSpace
    from geomtact.contact_space.touches import Touch
    from geomtact.se3 import Array
    from geomtact.sensing.noise import Noise


_FOUND = 0.25  # share of a contact that is found in its tactile image, below which the image shows something else
_LARGE = 0.1  # share of the window in contact, from which on pressing less deep helps


class NoiseName(StrEnum):
    none = "none"
    moderate = "moderate"
    heavy = "heavy"


def simulate(
    object_name: Annotated[
        str | None, typer.Argument(metavar="OBJECT", help="Object (see 'geomtact objects') or mesh file.")
    ] = None,
    unit: Unit = None,
    sensor: SensorName = None,
    out: Annotated[Path, typer.Option(help="Folder for the images and their poses.")] = Path("."),
    n: Annotated[
        int | None,
        typer.Option("--n", min=1, help="Number of touches at random poses, 1 by default.", show_default=False),
    ] = None,
    seed: Seed = 0,
    elastic: Annotated[
        bool,
        typer.Option(
            "--elastic/--rigid",
            help="Contact by the pressure of an elastic gel, or by a threshold on depth.",
        ),
    ] = False,
    noise: Annotated[NoiseName, typer.Option(help="Strength of the noise on the mask.")] = NoiseName.none,
    tactile_image: Annotated[
        bool,
        typer.Option(
            "--tactile-image", help="Write tactile images of an elastic gel and background.png instead of masks."
        ),
    ] = False,
    pose: Annotated[
        Path | None,
        typer.Option(
            help='JSON with "T_sensor_object" (4x4, object to sensor, metres): simulate one touch at this pose. The untouched '
            "membrane is at z = 0, and what presses it at z < 0."
        ),
    ] = None,
) -> None:
    """Simulate touches at known poses: write OBJECT_1.png (contact mask or tactile image), OBJECT_1.json (true pose), ...

    The images carry object and sensor in their metadata, so 'geomtact localize OBJECT_1.png' needs no options.
    Files of these names are overwritten, with a note.
    """
    from geomtact.cli.project import required, resolve
    from geomtact.contact_space.space import ContactSpace
    from geomtact.contact_space.touches import random_touches
    from geomtact.geometry.mesh_file import load_mesh
    from geomtact.sensing import noise as noises
    from geomtact.sensing.image_file import write_image
    from geomtact.sensing.sensor import Sensor

    check_folder(out)
    if pose is not None and n is not None:
        raise UsageError("--pose simulates one touch, --n touches at random poses; give one of them")
    values, _ = resolve({"object": object_name, "unit": unit, "sensor": sensor})
    named, sensor_named = required(values, "OBJECT")
    pressed = Sensor.load(sensor_named)
    mesh = load_mesh(named, values["unit"], sensor=pressed)
    for warning in mesh.warnings:
        to_stderr(f"warning: {warning}")
    space = ContactSpace(mesh, pressed)
    elastic = elastic or tactile_image
    strength = {NoiseName.none: noises.CLEAN, NoiseName.moderate: noises.MODERATE, NoiseName.heavy: noises.HEAVY}[noise]
    if pose is not None:
        touches = [_touch_at(space, read_pose(pose), seed, elastic, strength)]
    else:
        touches = random_touches(space, n or 1, seed, elastic=elastic, noise=strength)

    stems = [out / f"{mesh.name}_{k}" for k in range(1, len(touches) + 1)]
    background = out / "background.png" if tactile_image else None
    files = [Path(f"{stem}{suffix}") for stem in stems for suffix in (".png", ".json")]
    note_overwritten([*files, background])
    out.mkdir(parents=True, exist_ok=True)
    # files are named in full, so that the image is understood from any folder
    metadata = {key: str(Path(v).resolve()) if Path(v).is_file() else v for key, v in values.items() if v is not None}
    images: list[NDArray[np.generic]] = [touch.mask for touch in touches]
    if background is not None:
        untouched, *images = _tactile_images(space, touches, noise, seed)
        write_image(background, untouched, metadata)
    for stem, touch, image in zip(stems, touches, images, strict=True):
        truth = {
            "object": mesh.name,
            "sensor": pressed.name,
            "T_sensor_object": touch.T_sensor_object.tolist(),
            "penetration_mm": 1e3 * float(touch.penetration),
            "contact": "elastic" if elastic else "rigid",
            "noise": noise.value,
            "seed": seed,
        }
        _write(stem, image, truth, metadata)
        typer.echo(f"{stem}.png: {100 * touch.mask.mean():.1f} % of the window in contact")
        _warn(space, touch, Path(f"{stem}.png"), background)
    if background is not None:
        typer.echo(f"{background}: the untouched sensor, for --background")


def _tactile_images(
    space: ContactSpace, touches: Sequence[Touch], noise: NoiseName, seed: int
) -> list[NDArray[np.generic]]:
    """The tactile image (H, W, 3) of the untouched sensor, then one of each touch."""
    import numpy as np

    from geomtact.contact_space.touch import simulate_depth_map
    from geomtact.sensing.render import SPOILT, example_reading

    rng, sensor = np.random.default_rng([seed, 2]), space.sensor
    heights = [np.zeros(sensor.image_size_px[::-1]), *(simulate_depth_map(space, t.T_sensor_object) for t in touches)]
    return [example_reading(height, sensor.pixel_pitch, SPOILT[noise.value], rng) for height in heights]


def _warn(space: ContactSpace, touch: Touch, image: Path, background: Path | None) -> None:
    """Warn of a touch that no localization can return, or of a tactile image in which its contact is not found."""
    from geomtact.sensing.reading import read_observation

    sensor = space.sensor
    if not 0 < touch.penetration <= sensor.max_penetration:
        what = "is too deep" if touch.penetration > 0 else "does not touch"
        to_stderr(
            f"warning: the object {what} at this pose, so no localization can return it; check that T_sensor_object is in "
            "metres, the membrane at z = 0"
        )
    elif not space.admits(touch.T_sensor_object)[0]:
        to_stderr(
            "warning: the object enters the sensor's housing outside the window at this pose, deeper than its "
            f"housing_depth of {1e3 * (sensor.housing_depth or 0):g} mm, so no localization can return it; give another pose"
        )
    if background is None or not touch.mask.any():
        return
    found = read_observation(image, sensor, "reading", background).contact.mask
    share = float((found & touch.mask).sum() / touch.mask.sum())
    if touch.mask.all():
        why = "the contact fills the window, so no slope changes the colours; touch an edge"
    elif found.all() or share < _FOUND:
        press = "press less deep" if touch.mask.mean() > _LARGE else "press deeper"
        why = (
            f"by its colours {100 * found.mean():.1f} % of the window is in contact, not {100 * touch.mask.mean():.1f} %; "
            f"touch an edge or {press}"
        )
    else:
        return
    to_stderr(f"warning: {image}: localize would not find this contact: {why}, or leave --tactile-image out")


def read_pose(path: Path) -> Array:
    """``T_sensor_object`` (4, 4) from a JSON file that holds it under that name or alone.

    Raises
    ------
    InputError
        No JSON, or no such entry; PoseError if the matrix is no rigid transform.
    """
    from geomtact.json_values import read_json
    from geomtact.se3 import check_transforms

    try:
        content = read_json(path)
        T = content["T_sensor_object"] if isinstance(content, dict) else content
        return check_transforms(T, f"{path}: T_sensor_object").reshape(4, 4)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a JSON file") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f'{path}: expected JSON {{"T_sensor_object": 4x4 numbers}}, in metres') from None


def _touch_at(space: ContactSpace, T: Array, seed: int, elastic: bool, noise: Noise) -> Touch:
    import numpy as np

    from geomtact.contact_space.touch import simulate_mask, spoilt
    from geomtact.contact_space.touches import Touch

    mask = spoilt(simulate_mask(space, T, elastic), space, noise, np.random.default_rng(seed))
    return Touch(T, float(space.caster.penetration(space.sensor, T)[0]), mask, elastic)


def _write(stem: Path, image: NDArray[np.generic], truth: Mapping[str, object], metadata: Mapping[str, str]) -> None:
    """Write STEM.png, with ``metadata`` as text entries, and STEM.json."""
    from geomtact.files import write_text
    from geomtact.json_values import plain, to_text
    from geomtact.sensing.image_file import write_image

    pose = {"T_sensor_object": truth["T_sensor_object"]}
    write_image(f"{stem}.png", image, {**metadata, **pose})
    write_text(Path(f"{stem}.json"), to_text(plain(truth)))
