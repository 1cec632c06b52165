"""The rows of the table, from a session's episodes and the predictions for its agents."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from animat.closed_loop.agents import Agent
from animat.closed_loop.loop import Loop
from animat.closed_loop.session import Session
from animat.coding.encoder import electrode_pulses
from animat.evaluation.statistics import compare_episodes
from animat.goals.tally import Outcome
from animat.reality_gap.predicting import AgentPrediction, pool
from animat.reality_gap.row import Row
from animat.reality_gap.session_responses import outcomes
from animat.robots.starts import Starts

ALL_POLICIES = "policies"
"""The name of the row of all policies together."""


def session_rows(
    session: Session,
    agents: Sequence[Agent],
    names: tuple[str, ...],
    predicted: Mapping[str, AgentPrediction],
    loop: Loop,
    pulse_cost: float,
    starts: Starts | None,
) -> tuple[Row, ...]:
    """All policies together, then each of them if there are several, then the controls.

    The policies are the first of the agents, and have these `names`.
    """
    goal_outcomes, of_trials = outcomes(loop.robot, session), electrode_pulses(loop.conditions, loop.pulses)
    unstimulated = {agent.name for agent in agents if agent.delivery == "silent"}
    of_agents = {agent.name: [each.number for each in session.episodes if each.agent == agent.name] for agent in agents}
    turn_of = {number: turn for numbers in of_agents.values() for turn, number in enumerate(numbers)}
    is_drawn = starts is not None or len({episode.start for episode in session.episodes}) > 1

    def row(name: str, meaning: str, of: Sequence[str]) -> Row:
        episodes = [episode for episode in session.episodes if episode.agent in of]
        whole = [each for each in episodes if each.is_whole]
        actions = max(1, sum(each.iterations for each in episodes))
        trials = max(1, sum(each.trials for each in episodes))
        from_all = from_measured = pool([predicted[each] for each in of])
        turn = expected = predicted_pulses = None
        if is_drawn:
            turn = np.array([turn_of[each.number] for each in whole], np.int64)
            if whole and starts is not None:
                from_measured = pool([predicted[each.agent].of_start(turn_of[each.number]) for each in whole])
                expected = from_measured.returns.reshape(len(whole), -1).mean(axis=1)
        if of_trials is not None:
            predicted_pulses = float(from_measured.presented @ of_trials) * (name not in unstimulated)
        met = [goal_outcomes[episode.number] for episode in episodes if episode.number in goal_outcomes]
        return Row(
            name=name,
            meaning=meaning,
            predicted=from_measured.returns.ravel(),
            bootstrap_means=from_measured.bootstrap_means.mean(axis=1),
            measured=np.array([episode.total for episode in whole], np.float64),
            pulses_per_action=sum(each.pulses - each.warm_up_pulses for each in episodes) / actions,
            electrode_pulses=sum(each.electrode_pulses for each in whole) / len(whole) if whole else math.nan,
            predicted_electrode_pulses=predicted_pulses,
            pulse_cost=pulse_cost,
            bursts=sum(each.bursts for each in episodes) / trials,
            late=sum(each.late for each in episodes) / trials,
            met=Outcome(*map(np.stack, zip(*met, strict=True))).means() if met else {},  # type: ignore[arg-type]
            within=loop.robot.return_range,
            turn=turn,
            expected=expected,
            from_all_starts=float(from_all.returns.mean()),
        )

    policies = row(ALL_POLICIES if len(names) > 1 else names[0], "as trained", names)
    rows = [policies]
    # A single policy has its row already.
    for agent in agents if len(names) > 1 else agents[1:]:
        own = row(agent.name, agent.meaning, [agent.name])
        # With a different goal in mid-episode policies should do equally well: there is nothing to outperform.
        is_compared = agent.name not in names and agent.switch_at is None
        if is_compared and len(own.measured) and len(policies.measured):
            own = replace(own, comparison=compare_episodes(policies.measured, own.measured))
        rows.append(own)
    return tuple(rows)
