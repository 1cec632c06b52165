"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

# Shapes and types in the signatures of the numerical core are checked while the tests run; this must come before
# animat is imported.
install_import_hook(
    [
        "animat.neurons.simulator",
        "animat.animat",
        "animat.training.sac",
        "animat.evaluation.rollouts",
    ],
    "beartype.beartype",
)

from animat.compilation import keep_compilations  # noqa: E402

# The same random examples each time; others with --hypothesis-profile=default.
settings.register_profile("the same", derandomize=True)
settings.load_profile("the same")


@pytest.fixture(scope="session", autouse=True)
def compilations_kept() -> None:
    """Compile each program once a machine, not once a run of the tests."""
    keep_compilations()


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings beside the project, or where ANIMAT_REAL_DATA points; skips where it is absent."""
    folder = Path(os.environ.get("ANIMAT_REAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}: set ANIMAT_REAL_DATA to the folder that holds them")
    return folder
