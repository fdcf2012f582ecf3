"""JSON for scripts: ``result.json`` under the schema ``geomtact/localization/1``, and the lines of a sequence."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from geomtact.json_values import plain
from geomtact.se3 import quat_xyzw
from geomtact.versions import versions

if TYPE_CHECKING:
    from geomtact.inference.modes import Mode
    from geomtact.inference.posterior import Posterior

SCHEMA = "geomtact/localization/1"


def result(
    posterior: Posterior,
    modes: Sequence[Mode],
    settings: Mapping[str, Any] | None = None,
    timing_ms: Mapping[str, float] | None = None,
    candidates: Sequence[Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """The content of ``result.json``, ready for ``json.dumps``.

    Parameters
    ----------
    posterior : what was found
    modes : of the posterior, most probable first
    settings, timing_ms : added to the posterior's own; its own settings, which are the resolved ones, go first
    candidates : of an object identification, the most probable first
    """
    mesh, sensor = posterior.mesh, posterior.sensor
    return plain(
        {
            "schema": SCHEMA,
            "object": {"name": mesh.name, "sha256": mesh.sha256, "unit": mesh.unit},
            "sensor": sensor.name,
            **({} if candidates is None else {"candidates": candidates}),
            "frame": posterior.frame,
            "contact": bool(posterior.contact),
            "modes": [
                {
                    "probability": mode.probability,
                    "T": mode.T,
                    "translation_mm": 1e3 * np.asarray(mode.T)[:3, 3],
                    "quat_xyzw": quat_xyzw(mode.T),
                    "covariance": mode.covariance,
                    "observable": mode.observable,
                    "length": mode.length,
                }
                for mode in modes
            ],
            "information_gain_nats": posterior.information_gain_nats,
            "entropy_nats": posterior.entropy_nats,
            "effective_poses": posterior.effective_poses,
            "settings": {**(settings or {}), **posterior.settings},
            "diagnostics": asdict(posterior.diagnostics),
            "versions": versions(),
            "timing_ms": {**posterior.timing_ms, **(timing_ms or {})},
            "warnings": list(posterior.warnings),
        }
    )


def frame_line(n: int, posterior: Posterior) -> dict[str, Any]:
    """The ``n``-th image of a sequence: its contact (None if it could not be read), information and first mode."""
    first = next(iter(posterior.modes(1)), None)
    return {
        "frame": n,
        "contact": None if posterior.diagnostics.is_skipped else posterior.contact,
        "information_gain_nats": posterior.information_gain_nats if posterior.contact else None,
        "entropy_nats": posterior.entropy_nats if posterior.contact else None,
        "probability": None if first is None else first.probability,
        "T": None if first is None else first.T,
        "quat_xyzw": None if first is None else quat_xyzw(first.T),
        "translation_mm": None if first is None else 1e3 * first.T[:3, 3],
        "warnings": posterior.warnings,
    }


def to_line(content: Mapping[str, Any]) -> str:
    """JSON text without a line break."""
    return json.dumps(plain(content), allow_nan=False)
