"""Where the study departs from the paper: decisions taken, and comparisons that came out otherwise, with the limit."""

from __future__ import annotations

from typing import Any

from animat.evaluation.statistics import p_of_u
from animat.studies.specification import Study
from animat.studies.tabulating import LEVEL

NEAR = 0.95
"""Normalised score from which a condition leaves no room above it."""


def decisions(study: Study) -> tuple[tuple[str, str], ...]:
    """What the paper leaves open or contradicts, and what was decided."""
    simulators = study.simulators
    upper = "the largest response of the first recording, rounded up to 10 Hz"
    if simulators.range_hz is not None:
        upper = f"{simulators.range_hz:g} Hz"
    held = any(condition.percentiles == "first" for condition in study.conditions)
    return (
        (
            "The culture",
            "The paper's was alive. This one is simulated, grown from a seed, calibrated to published figures of "
            "cortical cultures and not "
            "to the paper's results. How large its responses are and how they tire differ from the paper's.",
        ),
        (
            "Nine levels without zero",
            "The paper prints nine thresholds, hence ten levels, from −1 to +1 in steps of 0.2, which would be "
            "eleven. Zero is left out: "
            "−1.0, −0.8, −0.6, −0.4, −0.2, +0.2, ..., +1.0. So the robot always moves.",
        ),
        (
            "Pole mass",
            "The paper's table prints 0.55 kg; the open simulator whose other numbers it repeats has 0.055 kg, which "
            "is used here "
            "(0.55 can be chosen: pole_mass_kg).",
        ),
        (
            "12 degrees",
            "The paper prints that an episode ends when the pole passes 12 rad, nearly two turns; 12 degrees, the "
            "simulator's, are used "
            "(angle_limit_rad).",
        ),
        (
            "20 iterations",
            "The paper prints at most 20 iterations for an episode of navigation: 0.5 m of path to a goal that is "
            "0.89 m away. 100 are used "
            "(episode_limit); with 20 no policy can reach the goal.",
        ),
        (
            "Histogram range",
            f"The paper's {simulators.bins} bins reach from 0 to 120 Hz, chosen for its culture. Here they end at "
            f"{upper}: where "
            "responses are small, bins as wide as the paper's erase the differences between frequencies.",
        ),
        (
            "Percentiles",
            "The paper does not say which recording the thresholds are taken from. Here they come from the recording "
            "whose simulator is in use, so "
            + (
                "they move, except in the conditions that hold the first recording's." if held else "they move with it."
            ),
        ),
        (
            "Drawing from a histogram",
            "A bin is drawn by its share, then a response evenly within it. What lies above the range counts into the "
            "last bin, and is reported.",
        ),
        (
            "Learning",
            "The paper's hosted platform is retired; it chose networks and settings by itself and took up to 60 "
            "minutes. Here it is discrete "
            "soft actor-critic with one set of settings for all, and the progress of training stands for the minutes "
            "of the culture's clock.",
        ),
        (
            "Before training",
            "The policies before training are the very networks that training starts from, drawn at random and all "
            "but undecided.",
        ),
        (
            "Pulse",
            "As published the pulse's phases do not balance (100 against 80 mV ms). The virtual culture takes it as "
            "it is; hardware would not.",
        ),
    )


def came_out_otherwise(rows: list[dict[str, Any]]) -> tuple[tuple[str, str], ...]:
    """For each comparison that differs from the paper: what came out, and what the best possible return says to it."""
    told = []
    for row in rows:
        if row["as_in_paper"] != "no":
            continue
        words = (
            f"The paper found {row['second']} better than {row['first']} (U = {row['paper_u']:g}, p = "
            f"{row['paper_p']:.3g}). "
            f"Here: {row['outcome']} (U = {row['u']:g}, p = {row['p_normal']:.3g}; mean returns "
            f"{row['mean_first']:.1f} and "
            f"{row['mean_second']:.1f}). {explain(row)}"
        )
        told.append((f"{row['comparison']}, {row['robot']}", words))
    return tuple(told)


def explain(row: dict[str, Any]) -> str:
    """What the limits say to a comparison's outcome."""
    n = int(row["n"])
    smallest = p_of_u(0.0, n, n)
    if smallest >= LEVEL:
        return f"With {n} policies a side p cannot fall below {smallest:.2g}, however they differ: take more policies."
    first, second, random = row["limit_first"], row["limit_second"], row["random_second"]
    if first is None or second is None or random is None:
        return "There is no limit to compare with."
    if second <= random:
        return (
            f"The best possible return, {second:.1f}, is not above that of random actions: there is nothing to learn."
        )
    limits = f"The best possible return is {first:.1f} for {row['first']} and {second:.1f} for {row['second']}"
    if second <= first and first != second:
        return f"{limits}: with these responses the order of the limits is itself the other way round."
    score_first, score_second = row["score_first"], row["score_second"]
    if score_first is not None and score_first >= NEAR:
        return f"{limits}, and {row['first']} comes to {score_first:.2f} of the way from random to it: no room is left."
    if score_second is not None and score_second >= NEAR:
        return f"{limits}; {row['second']} is at its limit (score {score_second:.2f}), so more cannot be had from it."
    scores = " and ".join("unknown" if s is None else f"{s:.2f}" for s in (score_first, score_second))
    return f"{limits}, random {random:.1f}; scores are {scores}. The limit leaves room, so it does not explain this."
