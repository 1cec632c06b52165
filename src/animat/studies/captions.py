"""How each figure of the report is read, and on how much it rests, in the order of the page.

What stands in braces is filled in for the study (`animat.studies.publishing`).
"""

from __future__ import annotations

HEADLINE = (
    "Each line is an arm, explained in the table below, at the last recording that it was evaluated on; further right "
    "is better. Small dots: each policy's mean return. Large dot: their interquartile mean (that of the middle half), "
    "with its 95 % interval; an arrow says that the interval goes on beyond the axis. Crosses: random actions. Bars: "
    "the optimal return, which no controller can exceed, where it is known. {policies} policies per arm."
)

CULTURE: dict[str, tuple[str, str]] = {
    "array": (
        "the array",
        "The array from above: one dot per recording site, the brighter the more it fires, and a circle round each "
        "electrode that was stimulated. The first recording, {channels} channels.",
    ),
    "raster": (
        "spikes around stimuli",
        "Above: each spike of a short stretch of the first recording; rows are channels. Below: what follows each "
        "stimulus, one row per stimulus; the darker, the more spikes. Between the two yellow lines a response is read.",
    ),
    "psth": (
        "post-stimulus time histogram",
        "Mean rate per channel against the time from the stimulus, over all stimuli of the first recording, whose "
        "number is given above. Responses are read in the shaded window.",
    ),
    "bursts": (
        "bursts set apart",
        "The {responses} responses of the first recording: how often each size x occurs, x against the share of "
        "active channels, one dot per response, and how often each share occurs. A burst activates many channels at "
        "once. {cut}",
    ),
    "responses": (
        "responses to each stimulus",
        "How large the responses to each stimulus are, bursts left out (n: how many). The further the histograms lie "
        "apart, the more a controller can do. The dashed line is P50, the median over all stimuli. The first "
        "recording: the neuron simulators are made of these numbers. Outlines, with a dotted P50: the last recording, "
        "where there are several; this is how far the culture moved in between.",
    ),
    "over-time": (
        "each stimulus over time",
        "One column per stimulus, one row per recording, from top to bottom; the mark is the median. A histogram that "
        "moves left is a culture that answers with less. Bursts are left out. Shares are of all responses; above "
        "stands how many lie beyond the axis, if any.",
    ),
    "drift": (
        "drift",
        "Above: percentiles of all non-burst responses. Middle: how often each stimulus is answered above their "
        "median; curves that come together are control that is lost. Below: the share of bursts. {recordings} "
        "recordings of about {responses} responses each.",
    ),
}

BURSTS = (
    "Right of the dashed threshold a response counts as one, as in the last panel. Bursts come regardless of the "
    "stimulus and are left out."
)
NO_BURSTS = "Here no response is set apart as one, so there is no threshold."
"""Of `bursts`, for {cut}."""

ROBOT: dict[str, tuple[str, str]] = {
    "learning": (
        "learning curves",
        "Return against iterations of training; up is better. Thin: each of {policies} policies. Thick: their mean "
        "with its 95 % bootstrap interval. Each point is over the episodes that ended within the {round} iterations "
        "before, in which every environment ends at least one; curves begin there, because the first episodes to end "
        "are not a representative sample. Actions are drawn. Lines: random actions and the optimal return with the "
        "simulator in use, which steps on with it (from the second recording on: on a rough grid). A control has no "
        "such return: whatever it chooses is as good as random.",
    ),
    "comparisons": (
        "comparisons",
        "One column per comparison, {policies} policies per side, each a point: its mean return over the episodes. "
        "Boxes: quartiles and median; whiskers reach to the furthest point within 1.5 times the box's height. Above "
        "with random actions and the optimal return, below close up. Stars: * p < 0.05, ** p < 0.01, *** p < 0.001, "
        "n.s. neither; p is two-sided, Mann-Whitney, normal approximation, corrected by Holm: “p corrected” of the "
        "table. Score, under each arm: (mean − random) / (optimal − random).",
    ),
    "over-time": (
        "at every recording",
        "The same policies on the simulator of each recording: median and quartiles over {policies} policies of "
        "{episodes_over_time} episodes each, with the optimal return. What falls with it is the simulator's: the "
        "culture's, and what its bins keep of it; what falls faster is the policy's. At every recording that return is "
        "on a rough grid, which can lie some below the fine one, and is left out for mappings without steps, such as "
        "linear.",
    ),
    "controls": (
        "controls",
        "One line per agent; further right is better. A control that does as well as trained policies says that what "
        "it lacks was not needed. Whiskers: standard errors over policies (for a control of one actor: over "
        "episodes), of {episodes} episodes each where no comparison says otherwise.",
    ),
    "paths": (
        "episodes",
        "One episode of each policy at the last recording. Blue: it arrived, or stayed up to the end; orange: not. "
        "These are only examples; rely on the figures above.",
    ),
    "frames": (
        "frames",
        "From the start of an episode to its end; the number under a frame is the iteration. One episode per arm, that "
        "of middle length: an example.",
    ),
}
