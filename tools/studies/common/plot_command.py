"""``python -m tools.studies plot``: the picture of a study, from its JSON alone."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tools.studies.common import study_file


def plot_study(
    study: Annotated[Path, typer.Argument(metavar="FILE.json", help="What a study wrote with --out.")],
    out: Annotated[Path, typer.Argument(metavar="FILE.png", help="Where the picture goes.")],
    picture: Annotated[
        str | None,
        typer.Option(
            "--picture",
            help="Which one, where a study has several: costs (the default) or ablations, of choices.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Draw the picture of a study from its JSON alone."""
    from geomtact.errors import InputError
    from geomtact.json_values import read_json

    try:
        content = read_json(study)
        if not isinstance(content, dict):
            raise ValueError("no object")
    except OSError as error:
        raise InputError(f"{study}: cannot be read ({error.strerror}); give what a study wrote with --out") from None
    except ValueError:
        raise InputError(f"{study}: is no JSON of a study; give what a study wrote with --out") from None
    study_file.plot(content, out, picture)
