"""The command line. Each command imports what it needs when it runs, so that ``geomtact --help`` is instant."""

from __future__ import annotations

import sys

import typer

from geomtact.cli.calibrate import calibrate
from geomtact.cli.evaluate import evaluate
from geomtact.cli.library import cache, objects, sensors
from geomtact.cli.localize import localize
from geomtact.cli.next_touch import next_touch
from geomtact.cli.prepare import prepare
from geomtact.cli.shell import check_words, claim_output, one_line_errors, one_line_usage_errors
from geomtact.cli.simulate import simulate
from geomtact.cli.track import track
from geomtact.cli.train import train
from geomtact.cli.view import view

EXAMPLES = """
[bold]Examples[/bold]

One sensor, an image that 'geomtact simulate' wrote:

  geomtact localize touch.png --out result

Your own mesh in millimetres, with a tactile image:

  geomtact localize touch.png --object part.stl --unit mm --sensor gelsight-mini --background untouched.png

Two sensors that touch the object at the same time:

  geomtact localize a.png b.png --object part.stl --unit mm --sensor gelsight-mini --sensor-poses poses.json
"""
SENSOR_POSES = """
poses.json for two sensors that face each other, 50 mm apart, the first at the world's origin:

  {"T_world_sensor": [[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]], [[1,0,0,0],[0,-1,0,0],[0,0,-1,0.05],[0,0,0,1]]]}

Each 4x4 matrix is row by row and maps sensor coordinates to world coordinates, in metres; they are in the order of the \
images. Sensor frame: origin at the image centre on the membrane, x right and y down in the image, z from the camera to \
the object. The world is any frame that the sensors share.

If the sensors differ, add "sensor": ["gelslim", "digit"]. If the matrices are uncertain, add "std_mm": 0.5, "std_deg": 0.2.
"""

RESULTS = """
[bold]Results[/bold]

"centre" is the object's centre, not the origin of its mesh. "±" is the standard deviation in the least certain direction. \
Observable directions are the motions that the contact constrains; "unknown" means that registration did not find the mode.

The poses as 4x4 matrices are in result.json, which --out writes and --json prints.
"""

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    help="Localize an object: from its mesh and tactile images to the distribution of its pose.",
    epilog=EXAMPLES
    + "\n\n'geomtact localize --help' shows the form of poses.json. 'geomtact sensors' lists the sensors.",
)
app.command(epilog=EXAMPLES + SENSOR_POSES + RESULTS)(one_line_errors(localize))
for command in (track, view, prepare, evaluate, train, simulate, calibrate, sensors, objects, cache):
    app.command()(one_line_errors(command))
app.command("next-touch")(one_line_errors(next_touch))


@app.callback(invoke_without_command=True)
def _root(version: bool = typer.Option(False, "--version", help="Print the version and stop.", is_eager=True)) -> None:
    if version:
        import geomtact

        typer.echo(f"geomtact {geomtact.__version__}")
        raise typer.Exit


def main() -> None:
    """Entry point of the ``geomtact`` command."""
    claim_output()
    with one_line_usage_errors():
        check_words(sys.argv[1:])
        sys.exit(app(prog_name="geomtact", standalone_mode=False))
