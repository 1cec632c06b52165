"""How many first pulses of an action come late in a closed loop on the CL1's simulator or the MaxOne's stand-in.

    CL_SDK_ACCELERATED_TIME=1 python benchmarks/late_pulses.py cl1 [--pulses 5] [--actions 200]
    python benchmarks/late_pulses.py cl1                  # in real time
    python benchmarks/late_pulses.py maxone

Needs what `reality_gap.py --backends` needs, and accelerated time an idle machine.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

import backends
from animat import Navigation, Thresholds
from animat.closed_loop.agents import Agent, OneCondition
from animat.closed_loop.loop import Loop
from animat.closed_loop.running import run_session
from animat.cultures.kinds import pulse_for
from animat.responses.condition import Condition

HZ = (5.0, 10.0, 20.0, 40.0, 80.0)


def main() -> None:
    """Run a session and print a row for each frequency."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("backend", choices=("cl1", "maxone"))
    parser.add_argument("--pulses", type=int, default=1, help="of each action")
    parser.add_argument("--actions", type=int, default=200, help="at each frequency")
    given = parser.parse_args()
    loop = Loop(
        # The goal is out of reach, so an episode has all actions.
        robot=Navigation(episode_limit=given.actions, goal_radius_m=1e-6),
        mapping=Thresholds(9),
        conditions=tuple(Condition(f"{hz:g} Hz", hz, "Hz") for hz in HZ),
        percentiles=np.linspace(0.0, 125.0, 11),
        pulses=given.pulses,
        pulse=pulse_for(given.backend),
        pause_s=0.1,
        warm_up=0,
    )
    agents = [Agent(f"{hz:g} Hz", "", OneCondition(i)) for i, hz in enumerate(HZ)]
    with tempfile.TemporaryDirectory() as folder, backends.opened(given.backend, 256, 1) as culture:
        session = run_session(culture, loop, agents, Path(folder) / "session", episodes=1)
        ticks = list(session.ticks)
    if session.ending.by != "plan":
        raise SystemExit(session.ending.message)
    print("| frequency | actions | late | by, ms |\n|---|---|---|---|")
    for agent in agents:
        late_ms = 1e3 * np.array([tick.late_s for tick in ticks if tick.agent == agent.name])
        late = late_ms[late_ms > 0]
        by = f"{late.min():.1f} to {late.max():.1f}" if len(late) else "-"
        print(f"| {agent.name} | {len(late_ms)} | {len(late)} | {by} |")


if __name__ == "__main__":
    main()
