"""Where the study departs from the paper: decisions taken, and comparisons that came out otherwise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

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

_CULTURES = {
    "virtual": "This one is simulated, grown from a seed, calibrated to published figures of cortical cultures and not "
    "to the paper's results. How large its responses are and how they tire differ from the paper's.",
    "files": "Here recordings at hand are used.",
}


def decisions(study: Study, series: Sequence[Responses] = ()) -> tuple[tuple[str, str], ...]:
    """What the paper leaves open or contradicts, and what this study does about it, with these responses."""
    return (
        *_of_size(study),
        *_of_culture(study),
        *_of_commands(study),
        *_of_simulators(study, series),
        *_of_learning(study),
    )


def _of_size(study: Study) -> Iterator[tuple[str, str]]:
    """Where there are more or fewer recordings, policies or iterations."""
    here, papers = study.culture, Source()
    if here.kind == "virtual" and _recorded(here) != _recorded(papers):
        yield "Recordings", f"The paper has {_recorded(papers)}. Here there are {_recorded(here)}."
    if study.policies != PAPER_POLICIES:
        yield "Policies", f"The paper has {PAPER_POLICIES} per arm. Here there are {study.policies}."
    trained = [spec for spec in study.robots if (spec.kind or spec.name) in {robot for _, robot in PRINTED}]
    for spec in trained:
        if spec.trained_for != (papers_own := spec.robot().paper_iterations):
            yield (
                f"Iterations on {spec.name}",
                f"The paper trains a policy for {papers_own:,}. Here it is trained for {spec.trained_for:,}.",
            )


def _recorded(culture: Source) -> str:
    mixed = "frequencies mixed" if culture.order == "mixed" else "each frequency in a block"
    pulses = "" if culture.pulses == 1 else f" of {culture.pulses} pulses"
    return (
        f"{culture.sessions} recordings, {culture.interval_min:g} minutes apart, of {culture.trials:,} trials of each "
        f"stimulus{pulses}, {mixed}"
    )


def _of_culture(study: Study) -> Iterator[tuple[str, str]]:
    yield "The culture", f"The paper's was alive. {_CULTURES[study.culture.kind]}"
    if study.culture.kind == "virtual":
        yield (
            "Pulse",
            "As published the pulse's phases do not balance (100 against 80 mV ms). The virtual culture takes it as "
            "it is; hardware would not.",
        )


def _of_commands(study: Study) -> Iterator[tuple[str, str]]:
    if any(arm.mapping == "9-thresholds" for arm in study.arms):
        yield (
            "Ten levels without zero",
            "The paper prints nine thresholds, hence ten levels, from −1 to +1 in steps of 0.2, which would be "
            "eleven. Zero is left out: −1.0, −0.8, −0.6, −0.4, −0.2, +0.2, ..., +1.0. So the robot always moves.",
        )
    for spec in study.robots:
        yield from spec.robot().departures()


def _of_simulators(study: Study, series: Sequence[Responses]) -> Iterator[tuple[str, str]]:
    simulators = study.simulators
    yield "Bursts", f"In the paper Otsu's threshold always cuts. {_cut(simulators.burst_threshold, series)}"
    papers = "The paper's 20 bins reach from 0 to 120 Hz, chosen for its culture. "
    if simulators.kind == "empirical":
        yield "Histogram", papers + "Here there are none: one of the measured responses is drawn."
    elif simulators.kind == "memory":
        yield (
            "Memory",
            "The paper's histogram answers the same whatever was before. Here one of the measured responses that had a "
            "similar history is drawn, so what a culture remembers is in it.",
        )
    else:
        if simulators.range_hz is None:
            here = (
                f"Here the edges of the {simulators.bins} bins are percentiles of each recording's own responses, all "
                "conditions together: where responses are small, or become smaller, equally wide bins erase the "
                "differences between conditions."
            )
        else:
            here = (
                f"Here {simulators.bins} bins of equal width reach to {simulators.range_hz:g} Hz. Controllability of "
                "every recording shows how often responses pass the median in the data and in the simulator: what "
                "parts the two is taken by binning."
            )
        yield "Histogram range", papers + here
        yield (
            "Drawing from a histogram",
            "A bin is drawn by its share, then a response evenly within it. What lies above the range counts into "
            "the last bin, and is reported.",
        )
    fixed = any(arm.percentiles == "first" for arm in study.arms)
    yield (
        "Percentiles",
        "The paper does not say which recording the thresholds are taken from. Here they come from the recording whose "
        "simulator is in use, so "
        + ("they move, except in the arms with those of the first recording." if fixed else "they move with it."),
    )


def _cut(threshold: float | None, series: Sequence[Responses]) -> str:
    """What sets bursts apart here, and how many responses stay that would not in the paper."""
    if threshold is not None:
        return f"Here the threshold is given: {threshold:g} of the channels."
    here = (
        "Here its cut is kept only where the ratios of active channels form two groups; elsewhere no response is set "
        "apart."
    )
    if not series:
        return here
    uncut = [of.active_ratio for of in series if not of.is_burst.any()]
    above = [n for ratios in uncut if (n := int(np.count_nonzero(ratios > otsu_threshold(ratios))))]
    return (
        f"{here} That is so in {len(above)} of {len(series)} recordings, which keep {sum(above):,} of "
        f"{sum(map(len, series)):,} responses that the paper's rule would leave out."
    )


def _of_learning(study: Study) -> Iterator[tuple[str, str]]:
    yield (
        "Learning",
        "The paper's hosted platform is retired; it chose networks and settings by itself and took up to 60 minutes. "
        "Here it is discrete soft actor-critic with one set of settings for all, and the progress of training stands "
        f"for {study.training_min:g} minutes of the culture's clock. The critics, which only training has, see how "
        "much of the episode is left, so that a time limit ends the return they learn; policies do not.",
    )
    if study.actions == "most probable":
        yield (
            "Most probable actions",
            "The paper does not say whether policies draw their actions when they are evaluated. Here they take the "
            "most probable one.",
        )
    else:
        yield (
            "Drawn actions",
            "The paper does not say whether policies draw their actions when they are evaluated. Here they do.",
        )
    if any(not arm.trained for arm in study.arms):
        yield (
            "Before training",
            "The policies before training are networks as training starts from them, drawn at random: all actions are "
            "nearly equally probable. "
            + (
                "Taking the most probable one makes a fixed rule of each, which can do worse than random actions."
                if study.actions == "most probable"
                else "They act as good as at random."
            ),
        )


def differing_comparisons(
    rows: Sequence[ComparedReturns], lost: Mapping[float, float] | None = None
) -> tuple[tuple[str, str], ...]:
    """For each comparison that differs from the paper or cannot tell: what came out, and what its optimum says to it.

    By the recording's minute it is given how far binning moved P(x >= P50) of any condition.
    """
    told = []
    for row in rows:
        if row.as_in_paper not in ("no", "cannot tell"):
            continue
        words = (
            f"The paper found {row.second} better than {row.first} (p = {row.paper_p:.3g}, which implies U = "
            f"{row.paper_u:g}). Here: {row.outcome} (U = {row.u:g}, p = {row.p_normal:.3g}; mean returns "
            f"{row.mean_first:.1f} and {row.mean_second:.1f}). {explain(row)}"
        )
        loss = (lost or {}).get(row.at_min, 0.0)
        if loss > LARGEST_LOSS:
            words += (
                f" In this recording binning moves P(x ≥ P50) by up to {loss:.2f}: policies and optimum are those of "
                "the simulator, and not all that the culture would allow."
            )
        told.append((f"{row.comparison}, {row.robot}", words))
    return tuple(told)


def explain(row: ComparedReturns) -> str:
    """What the optima say to a comparison's outcome."""
    n = row.n
    smallest = p_of_u(0.0, n, n)
    if smallest >= LEVEL:
        return (
            f"With {n} policies per side p cannot fall below {smallest:.2g}, however they differ: take more policies."
        )
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
        # A control has no optimum of its own: whatever it chooses, another condition is delivered.
        optima += f"; {row.first} cannot do better than random actions, {random:.1f}"
    else:
        optima = f"The optimal return is {first:.1f} for {row.first} and {second:.1f} for {row.second}"
        error = (row.optimum_error_first or 0.0) + error_second
        if first - second > error:
            return f"{optima}: with these responses the order of the optima is itself the other way round."
        if abs(first - second) <= error:
            optima += ", which is the same within their errors"
    # How much more than the first arm the second could have, as a part of all there is to learn.
    room = (second - row.mean_first) / (second - random)
    if room <= 1 - AIM:
        return (
            f"{optima}, and {row.first} has all but {100 * max(room, 0.0):.1f} % of what lies between random "
            "actions and that: no room is left."
        )
    score = row.score_second
    if score is not None and score >= AIM:
        return f"{optima}; {row.second} is at its optimum (score {score:.2f}), so more cannot be had from it."
    scores = " and ".join("unknown" if s is None else f"{s:.2f}" for s in (row.score_first, score))
    return (
        f"{optima}, random {random:.1f}; scores are {scores}. The optimum leaves room, {second - row.mean_first:.1f} "
        f"above {row.first}, so it does not explain this."
    )
