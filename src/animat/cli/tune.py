"""The command that searches for settings of a study."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from animat.cli.working import Working


@dataclass(frozen=True, kw_only=True)
class TuneFile(Working):
    """Search for the best settings of a study with one robot and one arm. Goes on where it stopped."""

    specification: Positional[Path]
    """The study's TOML file; its table [tune] says what is searched"""
    out: Path = Path("tuning")
    """Folder for everything; the settings found are best.toml in it"""

    def run(self) -> dict[str, Any]:
        """Search."""
        from animat.lined_up import lined_up
        from animat.tuning.search import expect_optuna
        from animat.tuning.specification import read_tuning

        tuning = read_tuning(self.specification)
        expect_optuna()
        from animat.tuning.results import BEST, HISTORY, IMPORTANCE, describe_settings
        from animat.tuning.run import tune
        from animat.tuning.space import first_settings

        self.say_first(tuning.study.robots)
        began = time.monotonic()
        with self.at_work("tuning") as how:
            tuned = tune(tuning, self.out, base=self.specification.parent, **how)
        cells = []
        names = ("own settings", "defaults")[: len(first_settings(tuning.study, tuning.space))]
        for final in sorted(tuned.finals, key=lambda each: -each.mean):
            error = "" if final.standard_error is None else f"{final.standard_error:.2g}"
            name = names[final.trial] if final.trial < len(names) else f"trial {final.trial}"
            mean = "diverged" if final.returns is None else f"{final.mean:.4g}"
            cells.append([name, mean, error, describe_settings(final.settings)])
        policies, episodes = tuning.study.policies, tuning.study.episodes
        counted = "1 policy" if policies == 1 else f"{policies} policies"
        print(f"trained anew, {counted} of each, in {episodes} fresh episodes per policy:")
        print("\n".join(lined_up(["", "mean return", "s.e.", "settings"], cells)))
        if tuned.importance:
            shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in tuned.importance.items())
            print(f"importance: {shares}")
        else:
            print("importance: too few trials with different returns to tell")
        pictures = [HISTORY, *([IMPORTANCE] if tuned.importance else [])]
        counted = ", ".join(f"{n} {state}" for state, n in tuned.to_dict()["trials"].items() if n)
        print(f"{len(tuned.trials)} trials ({counted}) in {time.monotonic() - began:.0f} s")
        print(f"best settings: {self.out / BEST}; figures: {', '.join(str(self.out / name) for name in pictures)}")
        return {"folder": str(tuned.folder), "best_toml": str(self.out / BEST), **tuned.to_dict()}
