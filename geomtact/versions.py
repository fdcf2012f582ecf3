"""What a result was made with."""

import platform
from importlib.metadata import PackageNotFoundError, version

PACKAGES = ("geomtact", "numpy", "scipy", "open3d", "torch", "embreex", "trimesh")


def versions(*more: str) -> dict[str, str]:
    """Versions of geomtact, of what computes for it, of ``more`` packages and of Python; "none" for what is not installed."""
    found = {"python": platform.python_version()}
    for package in (*PACKAGES, *more):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "none"
    return found
