"""What is to be seen in each figure of the report, in the order of the page."""

from __future__ import annotations

CULTURE: dict[str, tuple[str, str]] = {
    "array": ("the array", "Recording sites by their firing rate, and the electrodes that were stimulated."),
    "raster": (
        "spikes around stimuli",
        "A stretch of the first recording, and spikes around its stimuli; the response window is shaded.",
    ),
    "psth": (
        "post-stimulus time histogram",
        "Mean rate per channel against the time from the stimulus; responses are read in the shaded window.",
    ),
    "bursts": (
        "bursts set apart",
        "All responses x; x against the ratio of active channels; that ratio with Otsu's threshold; x against it with "
        "bursts marked. "
        "Bursts come regardless of the stimulus and are left out.",
    ),
    "responses": (
        "responses to each stimulus",
        "What the neuron simulators draw from, in the first recording; the line is P50, the median of all together.",
    ),
    "first-and-last": (
        "responses, first and last",
        "Filled: the first recording. Outline: the last. Lines: P50 of each.",
    ),
    "over-time": (
        "one stimulus over time",
        "Responses to the first stimulus, from recording to recording, with their medians.",
    ),
    "drift": (
        "drift",
        "Percentiles of all responses, P(x ≥ P50) of each stimulus, and the share of bursts, at every recording.",
    ),
}

ROBOT: dict[str, tuple[str, str]] = {
    "learning": (
        "learning curves",
        "Return of the episodes that ended in each part of training: every policy, their mean and its 95 % bootstrap "
        "interval. "
        "Lines: random actions and the best possible return at the first recording, of what is delivered as chosen.",
    ),
    "comparisons": (
        "comparisons",
        "Every point is a policy's mean return. Boxes: quartiles and median. * p < 0.05, ** p < 0.01, *** p < 0.001, "
        "two-sided "
        "Mann-Whitney U, normal approximation.",
    ),
    "over-time": (
        "at every recording",
        "The same policies on the simulator of each recording: median and quartiles over policies. What falls with "
        "the limit is the culture's; "
        "what falls faster is the policy's.",
    ),
    "controls": (
        "controls",
        "Mean returns at the last recording, with standard errors over policies (for a control of one actor: over "
        "episodes).",
    ),
    "paths": (
        "episodes",
        "One episode of each policy at the last recording. Blue: it arrived, or stayed up to the end; red: it did not.",
    ),
    "frames": ("frames", "From the start of an episode to its end; the number under a frame is the iteration."),
}
