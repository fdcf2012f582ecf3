"""``python -m tools.studies``: one study a command. Each imports what it needs when it runs, so that --help is instant."""

from __future__ import annotations

import sys

import typer

from geomtact.cli.several import Command
from geomtact.cli.shell import check_words, claim_output, one_line_errors, one_line_usage_errors
from tools.studies.adaptive import command as adaptive
from tools.studies.choices import command as choices
from tools.studies.common.by_part import by_part
from tools.studies.common.plot_command import plot_study
from tools.studies.identify.command import judge_identification
from tools.studies.kitting import command as kitting
from tools.studies.localize import command as localize
from tools.studies.next_touch import command as next_touch
from tools.studies.readings.command import judge_readings
from tools.studies.registration import command as registration
from tools.studies.samples.command import judge_samples
from tools.studies.scores import command as scores
from tools.studies.stability import command as stability
from tools.studies.thesis import command as thesis
from tools.studies.touches import command as touches
from tools.studies.track import command as track
from tools.studies.triplets.command import judge_triplets

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    help="Judge posteriors on touches with known poses: one study a command.",
)
COMMANDS: dict[str, Command] = {
    "samples": judge_samples,
    "localize": by_part(localize.judge_localize, localize.SCHEMA),
    "scores": by_part(scores.judge_scores, scores.SCHEMA, scores.words_meant),
    "registration": by_part(registration.judge_registration, registration.SCHEMA, registration.parts_meant),
    "thesis": by_part(thesis.judge_thesis_table, thesis.SCHEMA),
    "touches": by_part(touches.judge_touches, touches.SCHEMA),
    "readings": judge_readings,
    "triplets": judge_triplets,
    "identify": judge_identification,
    "track": by_part(track.judge_track, track.SCHEMA),
    "next-touch": by_part(next_touch.judge_next_touch, next_touch.SCHEMA),
    "kitting": by_part(kitting.judge_kitting, kitting.SCHEMA),
    "stability": by_part(stability.judge_stability, stability.SCHEMA),
    "choices": by_part(choices.judge_choices, choices.SCHEMA),
    "adaptive": by_part(adaptive.judge_adaptive, adaptive.SCHEMA),
    "plot": plot_study,
}
for name, command in COMMANDS.items():
    app.command(name)(one_line_errors(command))


def main() -> None:
    """Run the study that the command line names."""
    claim_output()
    with one_line_usage_errors():
        check_words(sys.argv[1:])
        sys.exit(app(prog_name="python -m tools.studies", standalone_mode=False))


if __name__ == "__main__":
    main()
