"""Differences between a study and the paper: decisions taken, and comparisons with another outcome."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from animat.errors import counted
from animat.evaluation.statistics import p_of_u
from animat.neurons.fidelity import LARGEST_LOSS
from animat.report.results import ComparedReturns
from animat.responses.bursts import otsu_threshold
from animat.responses.responses import Responses
from animat.studies.paper import PRINTED
from animat.studies.source import Source
from animat.studies.specification import Study
from animat.studies.tabulating import LEVEL

AIM = 0.97
"""Normalised score from which an arm counts as being as good as its optimum allows."""
PAPER_POLICIES = 10
"""Per arm. Source: Sawada et al. 2022."""


def decisions(study: Study, series: Sequence[Responses] = ()) -> Iterator[tuple[str, str]]:
    """Where the paper is silent or contradicts itself, and what this study does instead; `series` gives the numbers."""
    culture, paper = study.culture, Source()
    if study.needs_neurons and culture.kind == "virtual" and _recorded(culture) != _recorded(paper):
        yield "Recordings", f"The paper has {_recorded(paper)}. Here there are {_recorded(culture)}."
    if study.policies != PAPER_POLICIES:
        yield "Policies", f"The paper has {PAPER_POLICIES} per arm. Here there are {study.policies}."
    in_paper = {robot for _, robot in PRINTED}
    for spec in study.robots:
        if (spec.kind or spec.name) in in_paper and spec.trained_for != (iterations := spec.robot().paper_iterations):
            yield (
                f"Iterations on {spec.name}",
                f"The paper trains a policy for {iterations:,}. Here it is trained for {spec.trained_for:,}.",
            )
    if study.needs_neurons:
        yield from _culture_decisions(study)
    for spec in study.robots:
        yield from spec.robot().departures()
    if study.needs_neurons:
        yield from _simulator_decisions(study, series)
    yield (
        "Learning",
        "The paper's hosted platform is retired; it chose networks and settings by itself and took up to 60 minutes. "
        "Here discrete soft actor-critic is used with one set of settings for all, and training is taken to last "
        f"{study.training_min:g} minutes on the culture's clock. The critics, which are used only in training, see how "
        "much of the episode is left, so that a time limit ends the return they learn; policies do not.",
    )
    if study.actions == "most probable":
        actions, here = "Most probable actions", "take the most probable one"
        untrained = "Taking the most probable one turns each into a fixed rule, which can do worse than random actions."
    else:
        actions, here, untrained = "Drawn actions", "do", "They act almost at random."
    yield actions, f"The paper does not say whether policies draw their actions in evaluation. Here they {here}."
    if any(not arm.trained for arm in study.arms):
        yield (
            "Before training",
            "The policies before training are networks with random initial weights: all actions are nearly equally "
            f"probable. {untrained}",
        )


def _recorded(culture: Source) -> str:
    mixed = "frequencies mixed" if culture.order == "mixed" else "each frequency in a block"
    pulses = "" if culture.pulses == 1 else f" of {culture.pulses} pulses"
    return (
        f"{culture.sessions} recordings, {culture.interval_min:g} minutes apart, of {culture.trials:,} trials of each "
        f"stimulus{pulses}, {mixed}"
    )


def _culture_decisions(study: Study) -> Iterator[tuple[str, str]]:
    if study.culture.kind == "files":
        yield "The culture", "The paper's was alive. Here existing recordings are used."
    else:
        yield (
            "The culture",
            "The paper's was alive. This one is simulated, grown from a seed, and calibrated to published figures of "
            "cortical cultures, not to the paper's results. The size of its responses and their fatigue differ from "
            "the paper's.",
        )
        yield (
            "Pulse",
            "As published, the pulse's phases do not balance (100 against 80 mV ms). The virtual culture accepts it "
            "unchanged; hardware would not.",
        )
    if any(arm.mapping == "9-thresholds" for arm in study.arms):
        yield (
            "Ten levels without zero",
            "The paper prints nine thresholds, hence ten levels, from −1 to +1 in steps of 0.2, which would be "
            "eleven. Zero is left out: −1.0, −0.8, −0.6, −0.4, −0.2, +0.2, ..., +1.0. So the robot always moves.",
        )


def _simulator_decisions(study: Study, series: Sequence[Responses]) -> Iterator[tuple[str, str]]:
    simulators = study.simulators
    bursts = _burst_rule(simulators.burst_threshold, series)
    yield "Bursts", f"In the paper Otsu's threshold is always applied. {bursts}"
    paper = "The paper's 20 bins range from 0 to 120 Hz, chosen for its culture. "
    if simulators.kind == "empirical":
        yield "Histogram", paper + "Here there are no bins: one of the measured responses is drawn."
    elif simulators.kind == "memory":
        yield (
            "Memory",
            "The response of the paper's histogram does not depend on the past. Here one of the measured responses "
            "with a similar history is drawn, so the simulator includes the culture's memory.",
        )
    else:
        if simulators.range_hz is None:
            bins = (
                f"Here the edges of the {simulators.bins} bins are percentiles of each recording's own responses, all "
                "conditions together: where responses are small, or become smaller, bins of equal width erase the "
                "differences between conditions."
            )
        else:
            bins = (
                f"Here {simulators.bins} bins of equal width reach to {simulators.range_hz:g} Hz. Controllability of "
                "every recording shows how often responses exceed the median in the data and in the simulator: the "
                "difference is lost by binning."
            )
        yield "Histogram range", paper + bins
        yield (
            "Drawing from a histogram",
            "A bin is drawn with a probability equal to its share of the responses, then a response uniformly within "
            "it. Responses above the range count in the last bin, and are reported.",
        )
    fixed = any(arm.percentiles == "first" for arm in study.arms)
    yield (
        "Percentiles",
        "The paper does not say from which recording the thresholds are taken. Here they come from the recording whose "
        "simulator is in use, so "
        + ("they move, except in the arms with those of the first recording." if fixed else "they move with it."),
    )


def _burst_rule(threshold: float | None, series: Sequence[Responses]) -> str:
    """How bursts are separated here, and how many responses are kept that the paper would leave out."""
    if threshold is not None:
        return f"Here the threshold is set to {threshold:g} of the channels."
    rule = (
        "Here it is applied only where the ratios of active channels form two groups; elsewhere no response is set "
        "apart."
    )
    if not series:
        return rule
    uncut = [of.active_ratio for of in series if not of.is_burst.any()]
    above = [n for ratios in uncut if (n := int(np.count_nonzero(ratios > otsu_threshold(ratios))))]
    return (
        f"{rule} In {len(above)} of {len(series)} recordings this keeps responses that the paper's rule would leave "
        f"out, {sum(above):,} of {sum(map(len, series)):,} in total."
    )


def differing_comparisons(
    rows: Sequence[ComparedReturns], lost: Mapping[float, float] | None = None
) -> Iterator[tuple[str, str]]:
    """What differs from the paper or is undecided, and why; `lost`: how far binning moved P(x >= P50), by minute."""
    for row in rows:
        if row.as_in_paper not in ("no", "cannot tell"):
            continue
        text = (
            f"The paper found {row.second} better than {row.first} (p = {row.paper_p:.3g}, which implies U = "
            f"{row.paper_u:g}). Here: {row.outcome} (U = {row.u:g}, p = {row.p_normal:.3g}; mean returns "
            f"{row.mean_first:.1f} and {row.mean_second:.1f}). {explain(row)}"
        )
        loss = (lost or {}).get(row.at_min, 0.0)
        if loss > LARGEST_LOSS:
            text += (
                f" In this recording binning moves P(x ≥ P50) by up to {loss:.2f}: policies and optimum are those of "
                "the simulator, and not all that the culture would allow."
            )
        yield f"{row.comparison}, {row.robot}", text


def too_few_policies(n: int) -> str:
    """Why no difference can be found with so many policies per side; empty if one can."""
    smallest = p_of_u(0.0, n, n)
    policies = counted(n, "policy", "policies")
    why = f"With {policies} per side p cannot fall below {smallest:.3g}, unless some have equal returns"
    return "" if smallest < LEVEL else why


def explain(row: ComparedReturns) -> str:
    """What the optima say about a comparison's outcome."""
    if why := too_few_policies(row.n):
        return f"{why}: use more policies."
    first, second, random = row.optimum_first, row.optimum_second, row.random_second
    if second is None or random is None:
        return "There is no optimum to compare with."
    error_second = row.optimum_error_second or 0.0
    if second - random <= error_second:
        return (
            f"The optimal return for {row.second}, {second:.1f}, is not above that of random actions: "
            "there is nothing to learn."
        )
    optima = f"The optimal return is {second:.1f} for {row.second}"
    if first is None:
        # A control has no optimum: whatever it chooses, a random condition is delivered.
        optima += f"; {row.first} cannot do better than random actions, {random:.1f}"
    else:
        optima = f"The optimal return is {first:.1f} for {row.first} and {second:.1f} for {row.second}"
        error = (row.optimum_error_first or 0.0) + error_second
        if first - second > error:
            return f"{optima}: with these responses the order of the optima is itself the other way round."
        if abs(first - second) <= error:
            optima += ", which is the same within their errors"
    # How far the second arm could exceed the first, as a fraction of all there is to learn.
    room = (second - row.mean_first) / (second - random)
    if room <= 1 - AIM:
        return (
            f"{optima}, and {row.first} achieves all but {100 * max(room, 0.0):.1f} % of the range from random actions "
            "to it: no room is left."
        )
    score = row.score_second
    if score is not None and score >= AIM:
        return f"{optima}; {row.second} is at its optimum (score {score:.2f}), so it cannot improve."
    scores = " and ".join("unknown" if s is None else f"{s:.2f}" for s in (row.score_first, score))
    return (
        f"{optima}, random {random:.1f}; scores are {scores}. The optimum leaves room, {second - row.mean_first:.1f} "
        f"above {row.first}, so it does not explain this."
    )
