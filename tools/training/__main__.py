"""``python -m tools.training encoder|contact|likelihood|mixture``: train the bundled networks, fit the likelihood of contacts.

A stopped run goes on where it was.
"""

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


@app.command()
def likelihood(
    out: Annotated[Path, typer.Option(help="JSON file to write.")] = Path("contact-likelihood.json"),
    objects: Annotated[int, typer.Option(min=2, help="Procedural objects to touch.")] = 16,
    touches: Annotated[int, typer.Option(min=2, help="Touches of each.")] = 36,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    work: Work = None,
) -> None:
    """Fit what the likelihood of a contact depends on, on simulated touches of procedural objects.

    The package holds the fitted numbers in scoring/contact_likelihood.py.
    """
    from tools.training.likelihood import fit_likelihood

    with progress_bar("fitting") as progress:
        found = fit_likelihood(out, folder_of(work, out), objects, touches, seed, progress)
    to_stderr(f"{found.gain:.2f} nats at the true poses, {found.expected_gain:.2f} expected")


@app.command()
def mixture(
    out: Annotated[Path, typer.Option(help="JSON file to write.")] = Path("mixture.json"),
    objects: Annotated[int, typer.Option(min=2, help="Procedural objects to touch.")] = 24,
    touches: Annotated[int, typer.Option(min=2, help="Touches of each.")] = 40,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    work: Work = None,
) -> None:
    """Fit how a posterior mixes the powers of a contact's likelihood, on simulated touches of procedural objects.

    The package holds the fitted numbers in scoring/contact_likelihood.py.
    """
    from tools.training.mixture import fit_mixture

    with progress_bar("fitting") as progress:
        fits = fit_mixture(out, folder_of(work, out), objects, touches, seed, progress)
    for source, found in fits.items():
        to_stderr(f"{source}: {found.gain:.2f} nats at the true poses, {found.expected_gain:.2f} expected")


def with_rate(settings: Any, rate: float | None) -> Any:
    return settings if rate is None else replace(settings, rate=rate)


def folder_of(work: Path | None, out: Path) -> Path:
    return work or out.with_name(f"{out.stem}.training")


if __name__ == "__main__":
    app()
