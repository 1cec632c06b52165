"""Captions of the report's figures, in the order of the page: how to read each figure, and what data it rests on.

Placeholders in braces are filled in for the study (`animat.studies.publishing`).
"""

from __future__ import annotations

from typing import NamedTuple

from animat.studies.folder import RESPONSES


class Caption(NamedTuple):
    """The title and caption of a figure, and the files of its numbers; `{of}` is the robot's name."""

    title: str
    text: str
    numbers: tuple[str, ...] = ()


HEADLINE = (
    "Each row is an arm, described in the table below, at the last recording that it was evaluated on; further right "
    "is better. Small dots: each policy's mean return. Large dot: their interquartile mean (the mean of the middle "
    "half), with its 95 % interval, which is wide for few policies: that of four rests on two. An arrow means that it "
    "extends beyond the axis. Crosses: random actions. Bars: the optimal return, where it is known; no controller can "
    "exceed it by more than its error, given with the scores. {policies} per arm."
)

CULTURE = {
    "array": Caption(
        "the array",
        "The array from above. Each dot is a recording site; the brighter it is, the more it fires. A circle marks "
        "each stimulated electrode. The first recording, {channels}.",
        ("tables/culture-array.csv",),
    ),
    "raster": Caption(
        "spikes around stimuli",
        "Above: each spike of a short stretch of the first recording; rows are channels. Below: what follows each "
        "stimulus, one row per stimulus; the darker, the more spikes. Responses are read between the two yellow lines.",
    ),
    "psth": Caption(
        "post-stimulus time histogram",
        "Mean rate per channel against the time from the stimulus (the last pulse of a trial), over all stimuli of the "
        "first recording, whose number is given above. Responses are read in the shaded window. Where stimuli follow "
        "each other closely, later and earlier peaks are those of other stimuli.",
        ("tables/culture-psth.csv",),
    ),
    "bursts": Caption(
        "burst separation",
        "The first recording has {responses}: how often each size x occurs, x against the share of "
        "active channels, one dot per response, and how often each share occurs. A burst activates many channels at "
        "once. {cut}",
        ("tables/culture-bursts.csv", RESPONSES),
    ),
    "responses": Caption(
        "responses to each stimulus",
        "How large the responses to each stimulus are, without bursts (n: how many). The further apart the histograms "
        "lie, the more a controller can do. The dashed line is P50, the median over all stimuli. These are the numbers "
        "of the first recording, from which its neuron simulator is made. Outlines, with a dotted P50: the last "
        "recording, where there are several; they show how far the culture moved in between.",
        (RESPONSES, "tables/culture-conditions.csv"),
    ),
    "over-time": Caption(
        "each stimulus over time",
        "One column per stimulus, one row per recording, from top to bottom; the mark is the median. A histogram that "
        "moves left means that the culture responds less. Bursts are left out. Shares are of all responses; the title "
        "states how many lie beyond the axis, if any.",
        (RESPONSES, "tables/culture-conditions.csv"),
    ),
    "drift": Caption(
        "drift",
        "Above: percentiles of all non-burst responses. Middle: how often the response to each stimulus exceeds their "
        "median; curves that converge mean that control is lost. Below: the share of bursts, 0 where none can be set "
        "apart. {recordings} of about {responses} each.",
        ("tables/culture-drift.csv", "tables/culture-conditions.csv"),
    ),
}

BURSTS = (
    "A response to the right of the dashed threshold counts as a burst, as in the last panel. Bursts occur regardless "
    "of the stimulus and are left out."
)
NO_BURSTS = "Here no response is set apart as a burst, so there is no threshold."
"""Of `bursts`, for {cut}."""

ROBOT = {
    "learning": Caption(
        "learning curves",
        "Return against iterations of training; up is better. Thin: each policy ({policies}). Thick: their mean "
        "with its 95 % interval by Student's t. Each point is the mean over the episodes that ended within the {round} "
        "iterations before, in which every environment ends at least one. Curves begin there, because the first "
        "episodes to end are not a representative sample. Actions are drawn. Lines: random actions and the optimal "
        "return with the simulator in use, which changes with it (from the second recording on: on a coarse grid, and "
        "only for mappings with steps, not for linear). A control has no such return: whatever it chooses is as good "
        "as random. An arm whose episodes draw their recording has no lines, as it has no one simulator in use.",
        ("tables/{of}-learning.csv", "tables/learning-curves.csv"),
    ),
    "comparisons": Caption(
        "comparisons",
        "One column per comparison, {policies} per side, each a point: its mean return over the episodes. "
        "Boxes: quartiles and median; whiskers reach to the furthest point within 1.5 times the box's height. Above: "
        "with random actions and the optimal return. Below: enlarged. Stars: * p < 0.05, ** p < 0.01, *** p < 0.001, "
        "n.s. otherwise; p is two-sided, Mann-Whitney, normal approximation, corrected by Holm: “p corrected” in the "
        "table. Score, under each arm: (mean − random) / (optimal − random).",
        ("tables/comparisons.csv",),
    ),
    "over-time": Caption(
        "at every recording",
        "The same policies on the simulator of each recording: median and quartiles over {policies} of "
        "{episodes_over_time} each, with the optimal return. A fall that the optimal return shares is due to "
        "the simulator: to the culture, and to what its bins keep of it. A steeper fall is due to the policy. The "
        "optimal return at every recording is on a coarse grid, which can differ from the fine one, and is left "
        "out for mappings without steps, such as linear.",
        ("tables/{of}-over-time.csv",),
    ),
    "controls": Caption(
        "controls",
        "One row per agent; further right is better. If a control does as well as trained policies, what it lacks was "
        "not needed. Whiskers: standard errors over policies (for a control of one actor: over episodes), of "
        "{episodes} each where no comparison says otherwise.",
        ("tables/controls.csv",),
    ),
    "paths": Caption(
        "episodes",
        "One episode of each policy at the last recording. Blue: it ended well (on cartpole it lasted to the limit, on "
        "navigation it arrived); orange: it did not. These are only examples; rely on the figures above.",
        ("tables/{of}-paths.csv",),
    ),
    "frames": Caption(
        "frames",
        "From the start of an episode to its end; the number under a frame is the iteration. One episode per arm, that "
        "of median length: an example.",
    ),
}
