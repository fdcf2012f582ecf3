"""How long work reports its progress."""

from collections.abc import Callable

Progress = Callable[[float, str], None]  # called with the share done (0 to 1) and what is being done


def between(progress: Progress | None, begin: float, end: float) -> Progress | None:
    """``progress`` of a stage that lasts from one share of the whole work to another."""
    if progress is None:
        return None
    return lambda share, doing: progress(begin + share * (end - begin), doing)
