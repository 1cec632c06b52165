"""The specification of the paper's study, and the figures that the paper printed."""

from __future__ import annotations

from dataclasses import dataclass, replace

from animat.arguments import checked_arguments
from animat.studies.source import Source
from animat.studies.specification import Arm, Compared, RobotSpec, Study


@dataclass(frozen=True)
class Printed:
    """The paper's result of a comparison: p, and the U that this p implies. The second arm was better."""

    p: float
    u: float


PRINTED: dict[tuple[str, str], Printed] = {
    ("before and after training", "cartpole"): Printed(1.82e-4, 0),
    ("before and after training", "navigation"): Printed(1.83e-4, 0),
    ("control and 1 threshold", "cartpole"): Printed(1.83e-4, 0),
    ("control and 1 threshold", "navigation"): Printed(1.83e-4, 0),
    ("1 and 9 thresholds", "cartpole"): Printed(1.83e-4, 0),
    ("1 and 9 thresholds", "navigation"): Printed(3.30e-4, 2),
    ("without and with shadowing", "cartpole"): Printed(7.28e-3, 14),
    ("without and with shadowing", "navigation"): Printed(1.83e-4, 0),
}
"""By the comparison's and the robot's name. Source: Sawada et al. 2022, its table of comparisons."""

ARMS = (
    Arm("before training", trained=False),
    Arm("1 threshold"),
    Arm("9 thresholds", mapping="9-thresholds"),
    Arm("control", delivery="shuffled"),
    Arm("without shadowing", shadowing=False),
    Arm("linear", mapping="linear"),
    Arm("without neurons", mapping="none"),
)

COMPARISONS = (
    Compared("before and after training", "before training", "1 threshold", at_min=0.0, episodes=30),
    Compared("control and 1 threshold", "control", "1 threshold", at_min=140.0),
    Compared("1 and 9 thresholds", "1 threshold", "9 thresholds", at_min=140.0),
    Compared("without and with shadowing", "without shadowing", "1 threshold", at_min=140.0),
)


@checked_arguments
def paper_study(culture_seed: int = 1, seed: int = 1, *, quick: bool = False) -> Study:
    """The paper's study on the virtual culture of a seed; `seed` decides every draw of training and evaluation.

    `quick`: all steps with fewer policies, iterations and recordings: a first look, not a result.
    """
    study = Study(
        title="The paper's study on a virtual culture",
        culture=Source(seed=culture_seed),
        # On navigation's grid a resolution of 0.6 leaves an error of 0.01.
        robots=(RobotSpec("cartpole"), RobotSpec("navigation", optimum_resolution=0.6)),
        arms=ARMS,
        comparisons=COMPARISONS,
        seed=seed,
        paper=True,
    )
    if not quick:
        return study
    return replace(
        study,
        title=f"{study.title}, in short",
        culture=replace(study.culture, sessions=8, interval_min=20.0),
        robots=(RobotSpec("cartpole", iterations=60_000), RobotSpec("navigation", iterations=60_000)),
        policies=4,
        optimum_resolution=0.5,
        optimum_episodes=1000,
    )
