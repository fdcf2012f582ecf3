"""``python -m tools.training encoder|contact``: train the bundled networks anew. A stopped run goes on where it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from geomtact.cli.shell import progress_bar, to_stderr

Start = Annotated[Path | None, typer.Option(help="Weights to start from, instead of random ones.")]
Rate = Annotated[float | None, typer.Option(min=1e-9, help="Learning rate, where the usual one diverges.")]
Work = Annotated[Path | None, typer.Option(help="Folder for examples and state; by default named after --out.")]
app = typer.Typer(help=__doc__, no_args_is_help=True, pretty_exceptions_enable=False)


@app.command()
def encoder(
    out: Annotated[Path, typer.Option(help="Weights file to write.")] = Path("encoder.safetensors"),
    scenes: Annotated[int, typer.Option(min=50, help="Procedural objects to learn from.")] = 600,
    steps: Annotated[int, typer.Option(min=1)] = 4000,
    width: Annotated[int, typer.Option(min=8, help="Neurons a layer.")] = 512,
    dimension: Annotated[int, typer.Option(min=2, help="Numbers that the network makes of a contact.")] = 16,
    start: Start = None,
    rate: Rate = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    work: Work = None,
) -> None:
    """Train the shared encoder, which compares contacts, on simulated touches of procedural objects."""
    from geomtact.training.train import Settings
    from tools.training.encoder import train_encoder

    settings = with_rate(Settings(steps=steps, width=width, dimension=dimension, seed=seed), rate)
    with progress_bar("training") as progress:
        gain = train_encoder(out, folder_of(work, out), scenes, settings, start, progress)
    to_stderr(f"{gain:.2f} nats on scenes that it never saw")


@app.command()
def contact(
    out: Annotated[Path, typer.Option(help="Weights file to write.")] = Path("contact.safetensors"),
    scenes: Annotated[int, typer.Option(min=50, help="Procedural objects to press into gels.")] = 600,
    steps: Annotated[int, typer.Option(min=1)] = 6000,
    start: Start = None,
    rate: Rate = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    work: Work = None,
) -> None:
    """Train the contact network, which finds the contact in a tactile image, on simulated presses."""
    from tools.training.contact import Settings, train_contact_network

    settings = with_rate(Settings(steps=steps, seed=seed), rate)
    with progress_bar("training") as progress:
        overlap = train_contact_network(out, folder_of(work, out), scenes, settings, start, progress)
    to_stderr(f"overlaps the contact by {overlap:.2f} on objects that it never saw")


def with_rate(settings: Any, rate: float | None) -> Any:
    return settings if rate is None else replace(settings, rate=rate)


def folder_of(work: Path | None, out: Path) -> Path:
    return work or out.with_name(f"{out.stem}.training")


if __name__ == "__main__":
    app()
