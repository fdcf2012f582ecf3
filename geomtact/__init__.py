"""geomtact: the full probability distribution of an object's pose, from its mesh and the shape of one tactile contact.

The public names below are loaded when first used, so that ``import geomtact`` takes no time.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from geomtact.errors import (
    CacheError,
    GeomtactError,
    ImageError,
    InputError,
    MeshError,
    NoPoseAgreesError,
    PoseError,
    SensorError,
    UsageError,
)

if TYPE_CHECKING:
    from geomtact.contact_space.cell_transfer import ExtrinsicsStd
    from geomtact.geometry.mesh import Mesh
    from geomtact.geometry.mesh_file import load_mesh
    from geomtact.identification import identify
    from geomtact.inference.effort import Effort
    from geomtact.inference.gaussian_prior import GaussianPrior
    from geomtact.inference.modes import Mode
    from geomtact.inference.motion import GaussianTwist
    from geomtact.inference.posterior import Posterior
    from geomtact.localizer import Localizer
    from geomtact.planning.actions import Probe, Touch
    from geomtact.planning.next_touch import Action
    from geomtact.sensing.calibrate import calibrate
    from geomtact.sensing.contact import Contact
    from geomtact.sensing.height import contact_height
    from geomtact.sensing.local_shape import contact_mask
    from geomtact.sensing.sensor import Sensor

    __version__: str

_MODULE_OF = {
    "Action": "geomtact.planning.next_touch",
    "Contact": "geomtact.sensing.contact",
    "Effort": "geomtact.inference.effort",
    "GaussianPrior": "geomtact.inference.gaussian_prior",
    "GaussianTwist": "geomtact.inference.motion",
    "Localizer": "geomtact.localizer",
    "Mesh": "geomtact.geometry.mesh",
    "Mode": "geomtact.inference.modes",
    "Posterior": "geomtact.inference.posterior",
    "Probe": "geomtact.planning.actions",
    "ExtrinsicsStd": "geomtact.contact_space.cell_transfer",
    "Sensor": "geomtact.sensing.sensor",
    "Touch": "geomtact.planning.actions",
    "calibrate": "geomtact.sensing.calibrate",
    "contact_height": "geomtact.sensing.height",
    "contact_mask": "geomtact.sensing.local_shape",
    "identify": "geomtact.identification",
    "load_mesh": "geomtact.geometry.mesh_file",
}

__all__ = [
    "Action",
    "CacheError",
    "Contact",
    "Effort",
    "GaussianPrior",
    "GaussianTwist",
    "GeomtactError",
    "ImageError",
    "InputError",
    "Localizer",
    "Mesh",
    "MeshError",
    "Mode",
    "NoPoseAgreesError",
    "PoseError",
    "Posterior",
    "Probe",
    "ExtrinsicsStd",
    "Sensor",
    "SensorError",
    "Touch",
    "UsageError",
    "__version__",
    "calibrate",
    "contact_height",
    "contact_mask",
    "identify",
    "load_mesh",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("geomtact")
        except PackageNotFoundError:  # a checkout that is used without being installed
            return "unknown"
    if name in _MODULE_OF:
        value = getattr(importlib.import_module(_MODULE_OF[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'geomtact' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
