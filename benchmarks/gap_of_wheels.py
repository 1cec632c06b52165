"""Where the gap between predicted and measured return of `wheels` comes from: commands of other sources.

    animat record --places corners --out corners/
    animat train wheels --recordings corners/ --out wheels/
    animat run wheels/ --recordings corners/ --episodes 6 --controls random --seed 2 --out session/
    python benchmarks/gap_of_wheels.py wheels/ corners/ session/

The robot is moved on the simulator, from the session's starts, by commands that are drawn condition by condition. The
last table has the mean command of the condition with most electrodes, by the iteration of the episode.
"""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pandas as pd

from animat import Animat, Calibration, extract_series, load_policies, read_recordings
from animat.closed_loop.adaptive import AdaptiveThresholds
from animat.closed_loop.runner import starts_of
from animat.closed_loop.session import read_session
from animat.coding.decoder import decode
from animat.evaluation.rollouts import networks_of, roll_out
from animat.neurons.history_tracker import HistoryState
from animat.neurons.simulator import EmpiricalSimulator
from animat.responses.extraction import SILENCE_S

DRAWS, EPISODES = 4096, 300
PERIODS = (0, 3, 8, 15, 30, 60, 100)


def main(policies_in: str, recordings: str, session_in: str) -> None:
    """Print the two tables."""
    policies = load_policies(policies_in)
    first = next(iter(policies.values()))
    series = extract_series(read_recordings(recordings), window_ms=first.window_ms, readouts=first.readouts)
    calibration = Calibration.of_series(series, first)
    log = read_session(session_in).log
    ticks = pd.DataFrame([tick for record in log.fields() if (tick := record.get("tick"))])
    ours = ticks["agent"].isin(list(policies)) & (ticks["iteration"] >= 0)
    read_hz, delivered = np.array(ticks["readout_hz"].tolist()), ticks["delivered"].to_numpy()

    def commands(counts: np.ndarray) -> np.ndarray:
        """Both commands of each response, by thresholds that are moved only by the responses that count."""
        thresholds, tracker, state = AdaptiveThresholds(calibration.adjusted), calibration.remembering, HistoryState()
        percentiles, found = np.asarray(calibration.percentiles, np.float32), []
        for tick, x_hz, counted in zip(ticks.itertuples(), read_hz, counts, strict=True):
            found.append(decode(first.mapping, np.float32(x_hz), percentiles))
            rested = tick.read_after_s - state.at_s > SILENCE_S
            at_trial = tracker.when(state, tick.read_after_s, is_rested=rested)
            state = tracker.after(at_trial, tick.delivered, tick.rate_hz, is_burst=tick.is_burst)
            if counted and not tick.is_burst:
                thresholds.add(tick.delivered, at_trial, x_hz)
                percentiles = thresholds.percentiles()
        return np.array(found)

    as_run, without = commands(np.ones(len(ticks), bool)), commands((ticks["iteration"] >= 0).to_numpy())
    logged = np.array([command or (np.nan, np.nan) for command in ticks["command"]], float)
    assert np.nanmax(np.abs(as_run - logged)) < 1e-6, "the session's thresholds are not those of this code"
    outcome = json.loads((Path(session_in) / "returns.json").read_text())["rows"][0]
    rounds = outcome["episodes"] // len(policies)
    starts = starts_of(first.robot, log.header["seed"], rounds)
    environment = Animat(first.robot, first.mapping, len(calibration.conditions))
    networks, levels = networks_of(list(policies.values()), greedy=True), np.array(first.mapping.levels)

    def returned(of: np.ndarray, *, apart: bool = False) -> float:
        """The mean return with the commands of a condition as they come, or each readout drawn by itself."""
        rng, drawn = np.random.default_rng(1), []
        for condition in range(len(calibration.conditions)):
            rows = rng.choice(np.flatnonzero(ours & (delivered == condition)), (2, DRAWS))
            drawn.append(np.stack([of[rows[0], 0], of[rows[int(apart)], 1]], axis=-1))
        # Responses of which the mapping makes these commands.
        hz = 10.0 * np.searchsorted(levels, np.array(drawn) - 0.01) + 5.0
        percentiles = jnp.tile(jnp.arange(11) * 10.0, (2, 1))
        simulator = EmpiricalSimulator(jnp.asarray(hz), jnp.full(len(hz), DRAWS), percentiles)
        episodes = EPISODES // rounds * rounds
        return roll_out(environment, simulator, networks, episodes=episodes, seed=7, starts=starts).returns.mean()

    print("| commands from | return |\n|---|---|")
    print(f"| the simulator: the prediction | {outcome['predicted']:.1f} |")
    print(f"| the session, with thresholds that warm-up and settling do not move | {returned(without):.1f} |")
    print(f"| the session, with its own thresholds | {returned(as_run):.1f} |")
    print(f"| the same, each readout drawn by itself | {returned(as_run, apart=True):.1f} |")
    print(f"| measured | {outcome['measured']:.1f} |")
    most = int(np.argmax([max(map(len, condition.electrodes)) for condition in calibration.conditions]))
    recorded = commands(np.zeros(len(ticks), bool))
    print("\n| iterations | by the session's thresholds | by the recording's |\n|---|---|---|")
    for start, end in itertools.pairwise(PERIODS):
        rows = ours & (delivered == most) & ticks["iteration"].between(start, end - 1)
        if rows.any():
            print(f"| {start} to {end - 1} | {as_run[rows].mean():.2f} | {recorded[rows].mean():.2f} |")


if __name__ == "__main__":
    main(*sys.argv[1:])
