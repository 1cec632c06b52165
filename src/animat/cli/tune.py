"""The command that searches for the best settings of a study."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from animat.cli.command import JobOptions
from animat.errors import counted


@dataclass(frozen=True, kw_only=True)
class TuneFile(JobOptions):
    """Search for the best settings of a study with one robot and one arm. Resumes where it stopped."""

    specification: Positional[Path]
    """The study's TOML file; its table [tune] defines the search"""
    out: Path = Path("tuning")
    """Folder for all results; the best settings are in its best.toml"""

    def run(self) -> dict[str, Any]:
        from animat.terminal_table import align_columns
        from animat.tuning.specification import read_tuning

        tuning = read_tuning(self.specification)
        from animat.tuning.results import BEST, HISTORY, IMPORTANCE, describe_settings
        from animat.tuning.run import tune
        from animat.tuning.specification import first_settings

        self.print_caveats(spec.robot() for spec in tuning.study.robots)
        began = time.monotonic()
        with self.executing("tuning") as execution:
            tuned = tune(tuning, self.out, base=self.specification.parent, **execution)
        cells = []
        names = ("own settings", "defaults")[: len(first_settings(tuning.study, tuning.space))]
        errors = [each.standard_error for each in tuned.finals if each.standard_error]
        # The smallest standard error has two digits, unless it is only rounding.
        decimals = min(4, max(1, 1 - math.floor(math.log10(min(errors))))) if errors else 1
        for final in sorted(tuned.finals, key=lambda each: (-each.mean, each.trial)):
            error = "" if final.standard_error is None else f"{final.standard_error:.{decimals}f}"
            name = names[final.trial] if final.trial < len(names) else f"trial {final.trial}"
            mean = "diverged" if final.returns is None else f"{final.mean:.{decimals}f}"
            cells.append([name, mean, error, describe_settings(final.settings)])
        policies, episodes = counted(tuning.study.policies, "policy", "policies"), tuning.study.episodes
        print(f"retrained, {policies} of each, in {episodes} fresh episodes per policy:")
        print("\n".join(align_columns(["", "mean return", "s.e.", "settings"], cells)))
        shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in tuned.importance.items())
        print(f"importance: {shares or 'too few trials with different returns to tell'}")
        states = ", ".join(f"{n} {state}" for state, n in tuned.to_dict()["trials"].items() if n)
        print(f"{counted(len(tuned.trials), 'trial')} ({states}) in {time.monotonic() - began:.0f} s")
        figures = f"{self.out / HISTORY}{f', {self.out / IMPORTANCE}' if tuned.importance else ''}"
        print(f"best settings: {self.out / BEST}; figures: {figures}")
        return {"folder": str(tuned.folder), "best_toml": str(tuned.folder / BEST), **tuned.to_dict()}
