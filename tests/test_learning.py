"""Training at the paper's length against what is possible on made-up responses of known distributions.

Five conditions answer with gamma distributions of shape 6 and means 30, 36, 42, 48, 54 Hz, in 20 bins over 0-120 Hz.
By dynamic programming (`animat.evaluation.optimum`) no controller of the cartpole has a mean return above 18.5 with one
threshold and 71.2 with nine; without knowing the time left, as a policy does not, 16.9 and 68.9 were had. A random
one gets -80 and -77.
"""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest

from animat.evaluation.table import evaluate
from animat.mapping import mapping_named
from animat.neurons.conditions import Condition
from animat.neurons.made_up import made_up_simulator
from animat.neurons.timeline import SimulatorTimeline
from animat.recordings.protocol import Presentation
from animat.robots import Cartpole
from animat.training.specification import Training
from animat.training.trainer import train

pytestmark = pytest.mark.oracle


def made_up_timeline() -> SimulatorTimeline:
    return SimulatorTimeline(
        simulators=jax.tree.map(lambda leaf: leaf[None], made_up_simulator()),
        start_min=np.zeros(1),
        conditions=tuple(Condition(f"{f:g} Hz", f, "Hz") for f in (5.0, 10.0, 20.0, 40.0, 80.0)),
        window_ms=(2.0, 10.0),
        presentation=Presentation("blocked"),
        fidelities=(),
        findings=(),
    )


@pytest.mark.parametrize(
    ("mapping", "at_least", "at_most", "random"), [("1-threshold", 15, 18.5, -80), ("9-thresholds", 60, 71.2, -77)]
)
def test_policies_come_close_to_what_is_possible(
    mapping: str, at_least: float, at_most: float, random: float, tmp_path: Path
) -> None:
    training = Training(Cartpole(), mapping_named(mapping), policies=10, iterations=800_000, shadowing=False)
    policies = train(training, made_up_timeline(), tmp_path)
    rows = {row.name: row for row in evaluate(policies, made_up_timeline(), episodes=1_000).rows}
    trained = rows["policies"].mean_returns
    error = rows["policies"].episodes.returns.std() / np.sqrt(rows["policies"].episodes.returns.size)
    assert trained.mean() >= at_least
    assert trained.mean() <= at_most + 3 * error
    assert rows["random"].mean_returns[0] == pytest.approx(random, abs=2)
