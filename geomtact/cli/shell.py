"""What all commands share: exit statuses, one-line errors, progress and tables."""

from __future__ import annotations

import faulthandler
import functools
import io
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

from geomtact.errors import GeomtactError, InputError, UsageError, did_you_mean

USAGE_ERROR, BAD_INPUT, NO_CONTACT, INTERRUPTED = 2, 3, 4, 130
_NAMED = 4  # files that a note names
# of the library that parses the command line, as patterns, and what is said instead
_PLAIN_WORDS = {
    "Input should be greater than or equal to": "expected at least",
    "Input should be less than or equal to": "expected at most",
    "Input should be a valid integer.*": "expected a whole number",
    "Input should be a valid number.*": "expected a number",
}


def claim_output() -> None:
    """Keep standard error to geomtact's own lines: no log, warning or line of C code that a library writes there shows.

    A crash of the interpreter still leaves its trace there. File names that are no UTF-8, or that the terminal cannot show, are
    printed by number. Pictures go into files, whatever screen MPLBACKEND names.
    """
    os.environ["MPLBACKEND"] = "agg"
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    if isinstance(sys.stdin, io.TextIOWrapper):  # file names may come from there
        sys.stdin.reconfigure(errors="surrogateescape")
    logging.getLogger().addHandler(logging.NullHandler())
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    try:
        if sys.stderr.fileno() != 2:
            return
        own = os.dup(2)
    except (AttributeError, OSError, ValueError):  # closed, or no file
        return
    sys.stderr = open(own, "w", buffering=1, encoding=sys.stderr.encoding, errors="backslashreplace")  # noqa: SIM115
    faulthandler.enable(sys.stderr)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)


def one_line_errors(command: Callable[..., None]) -> Callable[..., None]:
    """``command`` with geomtact's and the system's errors reported in one line, and the exit status that fits."""

    @functools.wraps(command)
    def run(*args: object, **kwargs: object) -> None:
        try:
            command(*args, **kwargs)
        except GeomtactError as error:
            _report_error(str(error))
            raise typer.Exit(USAGE_ERROR if isinstance(error, UsageError) else BAD_INPUT) from None
        except KeyboardInterrupt:
            continues = command.__name__ == "evaluate" and kwargs.get("out") is not None
            to_stderr("interrupted" + "; the same command continues" * continues)
            raise typer.Exit(INTERRUPTED) from None
        except BrokenPipeError:
            # whoever read the output has gone; Python would complain once more when it flushes at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            _report_error(f"{where}{error.strerror or error}; check the path, its permissions and the free space")
            raise typer.Exit(BAD_INPUT) from None

    return run


@contextmanager
def one_line_usage_errors() -> Iterator[None]:
    """Reports in one line what is wrong with the command line, and exits."""
    try:
        yield
    except UsageError as error:
        _report_error(str(error))
        sys.exit(USAGE_ERROR)
    except (typer.Abort, EOFError):
        _report_error("stopped before the end; nothing more is written")
        sys.exit(1)
    except Exception as error:
        # typer's own errors, whose classes differ from version to version
        if not hasattr(error, "format_message"):
            raise
        message = _plain(error, error.format_message().rstrip("."))
        if message:  # it is empty where the help was printed
            context = getattr(error, "ctx", None)
            command = context.command_path if context else "geomtact"
            _report_error(f"{message[0].lower()}{message[1:]}; run '{command} --help'")
        sys.exit(USAGE_ERROR)


def _plain(error: Any, message: str) -> str:
    """The ``message`` of an ``error`` of typer's, with near names only and in plain words."""
    option = getattr(error, "option_name", None)
    if option is not None and "such option" in message.lower():
        known = [each.lstrip("-") for each in getattr(error, "possibilities", None) or ()]
        near = did_you_mean(option.lstrip("-"), known).replace("'", "'--", 1)
        return f"no such option: {option}{near}"
    for words, plain in _PLAIN_WORDS.items():
        message = re.sub(words, plain, message)
    return message


def check_words(words: Sequence[str]) -> None:
    """Refuse an empty word, which would mean this folder where a path is due.

    Raises
    ------
    UsageError
    """
    if "" in words:
        after = ["geomtact", *words][words.index("")]
        raise UsageError(f"expected a value after {after}, got an empty text; check your shell variables")


def check_folder(out: Path | None) -> None:
    """Refuse a file where a folder is to be written, before any work is done.

    Raises
    ------
    UsageError
    """
    if out is not None and out.is_file():
        raise UsageError(f"--out {out}: is a file; give a folder")


def check_file(path: Path | None, option: str) -> None:
    """Refuse a file that cannot be written where it is named, before any work is done.

    Raises
    ------
    UsageError
    """
    if path is not None and (path.is_dir() or not path.absolute().parent.is_dir()):
        raise UsageError(f"{option} {path}: expected a file in an existing folder; create the folder, or give another")


def note_overwritten(paths: Iterable[Path | None]) -> None:
    """Name the files among ``paths`` that are there, because they are about to be overwritten."""
    there = [str(path) for path in paths if path is not None and path.exists()]
    if there:
        more = f" and {len(there) - _NAMED} more" if len(there) > _NAMED else ""
        to_stderr(f"overwritten: {', '.join(there[:_NAMED])}{more}")


def posterior_file(path: Path, option: str = "") -> Path:
    """``path``, or the posterior.npz in it where it is a folder that ``localize --out`` wrote.

    Raises
    ------
    InputError
    """
    from geomtact.inference.files import file_of

    try:
        return file_of(path)
    except InputError as error:
        raise InputError(f"{option} {error}".strip()) from None


def to_stderr(text: str) -> None:
    """One line to standard error."""
    typer.echo(text, err=True)


def _report_error(text: str) -> None:
    to_stderr("error: " + " ".join(text.split()))


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[float, str], None]]:
    """A bar on standard error; yields what the library calls with the share done (0..1) and the step's name.

    It shows only once the library reports, so a cached index shows none. Where standard error is no terminal, each step
    and each tenth of it is a line.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
    task = bar.add_task(title, total=1.0)
    started, printed = False, ("", -1)

    def report(done: float, step: str = "") -> None:
        nonlocal started, printed
        if not started:
            started = True
            bar.start()
        description = f"{title}: {step}" if step else title
        bar.update(task, completed=done, description=description)
        reached = step, int(10 * done + 1e-9)
        if not console.is_terminal and reached != printed:
            printed = reached
            to_stderr(f"{description}, {10 * reached[1]} %")

    try:
        yield report
    finally:
        if started:
            bar.stop()


def print_table(headings: Iterable[str], rows: Iterable[Iterable[str]], right: Iterable[str] = ()) -> None:
    """A plain table on standard output; ``right`` names the columns that are set flush right."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table, right = Table(box=SIMPLE_HEAD, pad_edge=False), set(right)
    for heading in headings:
        table.add_column(Text(heading), justify="right" if heading in right else "left")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    console = Console()
    if not console.is_terminal:
        console.width = 160  # a pipe has no width to keep to
    console.print(table)
