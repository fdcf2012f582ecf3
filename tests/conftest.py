"""Fixtures shared by all tests."""

import os
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of real readings and meshes; tests that need it are skipped where it is not given."""
    folder = os.environ.get("GEOMTACT_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("set GEOMTACT_DATA to the folder of real readings")
    return Path(folder).resolve()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
