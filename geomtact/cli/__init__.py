"""The command line. Each command imports what it needs when it runs, so that ``geomtact --help`` is instant."""

from __future__ import annotations

import sys

import typer

from geomtact.cli.calibrate import calibrate
from geomtact.cli.library import cache, objects, sensors
from geomtact.cli.localize import localize
from geomtact.cli.next_touch import next_touch
from geomtact.cli.prepare import prepare
from geomtact.cli.shell import check_words, claim_output, one_line_errors, one_line_usage_errors
from geomtact.cli.simulate import simulate
from geomtact.cli.track import track
from geomtact.cli.train import train
from geomtact.cli.view import view

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    help="Localize a known part from the shape of one tactile contact: the whole distribution of its pose.",
)
for command in (localize, track, view, prepare, train, simulate, calibrate, sensors, objects, cache):
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
