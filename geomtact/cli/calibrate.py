"""``geomtact calibrate``: from presses of one ball to a sensor file whose colours measure indentation depth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from geomtact.cli.options import Mirror, Mounting, Rotate, SensorName
from geomtact.cli.shell import note_overwritten, to_stderr
from geomtact.errors import UsageError
from geomtact.files import write_bytes, write_text

if TYPE_CHECKING:
    from geomtact.sensing.calibrate import SensorCalibration
    from geomtact.sensing.sensor import Sensor


def calibrate(
    presses: Annotated[
        list[Path],
        typer.Argument(
            metavar="PRESS...", help="Images of one ball pressed at many places; or Taxim's table, polycalib.npz."
        ),
    ],
    background: Annotated[Path, typer.Option(help="Tactile image of the untouched sensor.")],
    ball_mm: Annotated[float | None, typer.Option("--ball-mm", help="Diameter of the ball.")] = None,
    pitch_mm: Annotated[
        tuple[float, float] | None,
        typer.Option("--pitch-mm", help="Millimetres per pixel on the membrane, along x and along y."),
    ] = None,
    pins: Annotated[
        Path | None, typer.Option(help="Instead of --pitch-mm: image of a square pin board pressed into the gel.")
    ] = None,
    pin_spacing_mm: Annotated[
        float | None, typer.Option("--pin-spacing-mm", help="Distance between neighbouring pins of that board.")
    ] = None,
    other_presses: Annotated[
        Path | None, typer.Option(help="Folder of presses of another ball, to measure the membrane's curvature.")
    ] = None,
    other_ball_mm: Annotated[float | None, typer.Option("--other-ball-mm", help="Diameter of that ball.")] = None,
    sensor: SensorName = None,
    rotate: Rotate = None,
    mirror: Mirror = None,
    name: Annotated[str | None, typer.Option(help="Name of the new sensor.")] = None,
    out: Annotated[Path, typer.Option(help="Sensor file to write.")] = Path("sensor.toml"),
    plot: Annotated[Path | None, typer.Option(help="PNG to write that shows how well the presses fit.")] = None,
) -> None:
    """Calibrate a sensor's colours from presses of a ball of known diameter, so that its images measure indentation depth.

    Give a dozen presses, spread over the window; they take half a minute. The pixel pitch comes from --pitch-mm, from
    --pins, or from --sensor, whose geometry is kept.
    """
    from geomtact.report.calibration_plot import draw_calibration
    from geomtact.sensing.calibrate import calibrate_sensor

    mounting = Mounting(rotate, mirror)
    for path, suffix in ((out, ".toml"), (plot, ".png")):
        if path is not None and path.suffix != suffix:
            raise UsageError(f"{path}: expected a file name that ends in {suffix}; rename it")
        if path is not None and not path.parent.is_dir():
            raise UsageError(f"{path}: no folder {path.parent}; create it, or give another")
    presses = [path for path in presses if path.absolute() != background.absolute()] or presses  # *.png names it, too
    folder = next((path for path in presses if path.is_dir()), None)
    if folder is not None:
        raise UsageError(f"{folder}: expected images, got a folder; give {folder}/*.png")
    balls = (("--ball-mm", ball_mm), ("--other-ball-mm", other_ball_mm))
    lengths = [(option, 0.1, value) for option, value in balls] + [("--pitch-mm", 0.001, pitch_mm and min(pitch_mm))]
    for option, least, value in lengths:
        if value is not None and not least < value < 1000 * least:
            raise UsageError(
                f"{option} {value:g}: expected {least:g} to {1000 * least:g} millimetres; multiply metres by 1000"
            )
    pitch = None if pitch_mm is None else (1e-3 * pitch_mm[0], 1e-3 * pitch_mm[1])
    if pins is not None or pin_spacing_mm is not None:
        if pins is None or pin_spacing_mm is None or pitch is not None:
            raise UsageError("--pins and --pin-spacing-mm belong together and replace --pitch-mm; give these two alone")
        pitch = _pitch_of(pins, background, 1e-3 * pin_spacing_mm)
        if _quarter_turned(sensor, mounting):
            pitch = pitch[::-1]
    if (other_presses is None) != (other_ball_mm is None):
        raise UsageError("--other-presses and --other-ball-mm belong together; give both")
    if other_presses is not None and not other_presses.is_dir():
        raise UsageError(f"--other-presses {other_presses}: expected a folder with presses of another ball; give it")
    if presses[0].suffix == ".npz":
        if len(presses) > 1 or ball_mm is not None or plot is not None or other_presses is not None:
            raise UsageError(f"{presses[0]}: a table of Taxim needs no presses, balls or --plot; leave these out")
        if mounting.is_given:
            raise UsageError(f"{presses[0]}: a table of Taxim fits unturned images; leave --rotate and --mirror out")
        _write(_of_taxim(presses[0], background, pitch, sensor, name or out.stem), sensor, out)
        return
    if ball_mm is None:
        raise UsageError("--ball-mm: expected the ball's diameter in millimetres, got none; give it")
    mounted = _mounted(sensor, background, pitch, mounting)
    found = calibrate_sensor(presses, 1e-3 * ball_mm, background, pitch, mounted, name or out.stem)
    for why in dict.fromkeys(found.left_out.values()):
        names = [name for name, reason in found.left_out.items() if reason == why]
        to_stderr(f"warning: left out ({why}): {', '.join(names)}")
    _print(found, ball_mm)
    for warning in found.warnings:
        to_stderr(f"warning: {warning}")
    if other_presses is not None and other_ball_mm is not None:
        _print_membrane(found, ball_mm, other_presses, other_ball_mm, background)
    _write(found.sensor, sensor, out)
    if plot is not None:
        note_overwritten([plot])
        write_bytes(plot, draw_calibration(found, 1e-3 * ball_mm))
        typer.echo(f"wrote {plot}")


def _write(calibrated: Sensor, geometry: str | None, out: Path) -> None:
    """Write a sensor's file; ``geometry`` is whose it has."""
    note_overwritten([out])
    write_text(out, calibrated.to_toml())
    typer.echo(f"wrote {out}; geomtact.contact_height(image, background, {str(out)!r}) returns depth maps")
    if geometry is None:
        typer.echo(
            "assumed: parallel camera rays, a flat gel, 2 mm deep. For another geometry write a sensor file and calibrate "
            "again with --sensor"
        )


def _quarter_turned(sensor: str | None, mounting: Mounting) -> bool:
    """Whether the camera's columns are the sensor's rows."""
    from geomtact.sensing.sensor import Sensor

    if mounting.rotate is not None or sensor is None:
        return mounting.rotate in (90, 270)
    return Sensor.load(sensor).camera_rotation_deg in (90, 270)


def _mounted(
    sensor: str | None, background: Path, pitch: tuple[float, float] | None, mounting: Mounting
) -> Sensor | str | None:
    """The sensor whose geometry to keep, mounted as given; where none is named, one of the background's size."""
    from geomtact.sensing.image_file import read_image
    from geomtact.sensing.sensor import Sensor

    if not mounting.is_given:
        return sensor
    if sensor is not None:
        return mounting.of(sensor, masks=False)
    if pitch is None:
        return None
    height, width = read_image(background).shape[:2]
    size = (height, width) if _quarter_turned(None, mounting) else (width, height)
    return mounting.of(Sensor("calibrated", size, pitch, 0.0, 2e-3), masks=False)


def _of_taxim(
    table: Path, background: Path, pitch: tuple[float, float] | None, sensor: str | None, name: str
) -> Sensor:
    """The sensor with the colour calibration of a table of Taxim."""
    from dataclasses import replace

    from geomtact.sensing.change import as_unit_rgb, check_size
    from geomtact.sensing.colour import kept
    from geomtact.sensing.sensor import Sensor
    from geomtact.sensing.taxim import colours_of_taxim

    rest = as_unit_rgb(background, "background")
    height, width = rest.shape[:2]
    if sensor is None and pitch is None:
        raise UsageError(f"{table}: a table of Taxim has no pitch; give --pitch-mm, --pins or --sensor")
    base = Sensor.load(sensor) if sensor is not None else Sensor(name, (width, height), pitch or (0.0, 0.0), 0.0, 2e-3)
    check_size(rest, base, str(background))
    if base.turned:
        raise UsageError(
            f"--sensor {sensor}: its camera is turned, but a table of Taxim fits unturned images; name another sensor"
        )
    colour = replace(colours_of_taxim(table, (height, width)), background=kept(rest))
    typer.echo(
        f"error of slopes up to 30 degrees in the table: {colour.slope_rms:.3f} rms (a slope of 1 is 45 degrees)"
    )
    return replace(base, name=name, pixel_pitch=pitch or base.pixel_pitch, colour=colour)


def _print_membrane(found: SensorCalibration, ball_mm: float, folder: Path, other_mm: float, background: Path) -> None:
    """Print the membrane's curvature, measured with presses of another ball."""
    from geomtact.cli.frames import listed
    from geomtact.sensing.calibrate import calibrate_sensor
    from geomtact.sensing.membrane import membrane_curvature

    second = calibrate_sensor(sorted(listed(folder)), 1e-3 * other_mm, background, sensor=found.sensor)
    curvature, std = membrane_curvature(found, 1e-3 * ball_mm, second, 1e-3 * other_mm)
    typer.echo(f"  membrane              curvature {1e-3 * curvature:.4f} ± {1e-3 * std:.4f} 1/mm")
    if curvature > 2 * std:
        typer.echo(f"  (to use it, set membrane_radius_mm = {1e3 / curvature:.0f} in the file of --sensor)")
    else:
        typer.echo("  (the membrane is flat within that uncertainty)")


def _pitch_of(pins: Path, background: Path, spacing: float) -> tuple[float, float]:
    """The pixel pitch [m] measured with an image of a pin board; it is printed."""
    from geomtact.sensing.image_file import read_image
    from geomtact.sensing.pins import pixel_pitch_of_pins

    board = pixel_pitch_of_pins(read_image(pins), read_image(background), spacing)
    x, y = 1e3 * board.pixel_pitch[0], 1e3 * board.pixel_pitch[1]
    typer.echo(
        f"{len(board.pins)} pins: pixel pitch {x:.4f} x {y:.4f} mm ± {100 * max(board.std):.1f} % in the middle; "
        f"{100 * board.stretch:.0f} % less at the outermost pins"
    )
    return board.pixel_pitch


def _print(found: SensorCalibration, ball_mm: float) -> None:
    import numpy as np

    colour, mm = found.sensor.colour, 1e3 * found.diameters
    assert colour is not None
    low, middle, high = np.nanquantile(mm, [0.25, 0.5, 0.75])
    typer.echo(
        f"{len(mm)} of {len(mm) + len(found.left_out)} presses used; each measured with a table fitted to the others:\n"
        f"  ball diameter         {middle:.2f} mm (half of the presses: {low:.2f} to {high:.2f}), given {ball_mm:g} mm;\n"
        "                        this checks that the presses agree, not that --ball-mm is right\n"
        f"  slope error           {colour.slope_rms:.3f} rms (a slope of 1 is 45 degrees)\n"
        f"  depth error           {1e3 * colour.height_rms:.3f} mm rms where nothing touches\n"
        f"  depth noise           {1e3 * found.sensor.height_noise:.3f} mm rms under the ball, correlated over "
        f"{1e3 * found.sensor.height_correlation:.2f} mm\n"
        f"  contact threshold     {1e3 * colour.contact_depth:.2f} mm indentation depth"
    )
