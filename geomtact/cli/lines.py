"""The JSON line that is printed for each image of a sequence."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from geomtact.inference.posterior import Posterior


def line_of(n: int, posterior: Posterior) -> dict[str, Any]:
    """The ``n``-th image's contact (None if it could not be read), information and first mode."""
    from geomtact.se3 import quat_xyzw

    first = next(iter(posterior.modes(1)), None)
    return {
        "frame": n,
        "contact": posterior.contact if posterior.observations else None,
        "information_gain_nats": -posterior.entropy_nats if posterior.contact else None,
        "entropy_nats": posterior.entropy_nats if posterior.contact else None,
        "probability": None if first is None else first.probability,
        "T": None if first is None else first.T,
        "quat_xyzw": None if first is None else quat_xyzw(first.T),
        "translation_mm": None if first is None else 1e3 * first.T[:3, 3],
        "warnings": posterior.warnings,
    }


def to_line(line: dict[str, Any]) -> str:
    """As JSON, without a line break."""
    import json

    from geomtact.report.result import plain

    return json.dumps(plain(line), allow_nan=False)
