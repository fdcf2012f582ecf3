"""Methods that take turns on the same items, so that all meet the same neighbours on a busy machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Way:
    """One variant: ``run`` maps an item to its result. It reads ``bytes`` bytes, and gets ``most`` items at most."""

    method: str
    run: Callable[[Any], Any]
    bytes: float = 0.0
    most: int = 1 << 30
    ms: list[float] = field(default_factory=list)
    verdicts: list[dict[str, Any]] = field(default_factory=list)


def take_turns(ways: list[Way], items: Iterable[Any], judge: Callable[[Any, Any], dict[str, Any]]) -> None:
    """Measures the time of each variant for each item, one after the other; the first item is not counted.

    ``judge`` compares a result with that of geomtact, which is the first variant.
    """
    for k, item in enumerate(items):
        own = None
        for way in ways:
            if k > way.most:
                continue
            began = time.perf_counter()
            answer = way.run(item)
            took = 1e3 * (time.perf_counter() - began)
            own = answer if own is None else own
            if k:
                way.ms.append(took)
                way.verdicts.append({} if answer is None or answer is own else judge(own, answer))
