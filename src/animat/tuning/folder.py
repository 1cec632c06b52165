"""A tuning's description, which lies in its folder (`animat.studies.folder.held`)."""

from __future__ import annotations

import importlib.metadata
from typing import Any

from animat.differences import with_fingerprint
from animat.studies.folder import describe_study
from animat.tuning.specification import Tuning

MANIFEST = "tune.json"


def describe_tuning(tuning: Tuning, sources: dict[str, str]) -> dict[str, Any]:
    """What decides how a tuning comes out, as of a study (`describe_study`), with a fingerprint over all of it."""
    versions = {**describe_study(tuning.study, sources)["versions"], "optuna": importlib.metadata.version("optuna")}
    return with_fingerprint({**tuning.to_dict(), "sources": sources, "versions": versions})
