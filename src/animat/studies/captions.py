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
        "All responses x, bursts among them; x against the ratio of active channels; that ratio with Otsu's "
        "threshold; x against it with bursts marked. Bursts come regardless of the stimulus and are left out.",
    ),
    "responses": (
        "responses to each stimulus",
        "Non-burst responses in the first recording, which the neuron simulators are made of; the line is P50, their "
        "median over all stimuli.",
    ),
    "first-and-last": (
        "responses, first and last",
        "Non-burst responses. Filled: the first recording. Outline: the last. Lines: P50 of each.",
    ),
    "over-time": (
        "one stimulus over time",
        "Non-burst responses to the first stimulus, from recording to recording, with their medians.",
    ),
    "drift": (
        "drift",
        "Percentiles of the non-burst responses to all stimuli, P(x ≥ P50) of each stimulus, and the share of "
        "bursts, at every recording.",
    ),
}

ROBOT: dict[str, tuple[str, str]] = {
    "learning": (
        "learning curves",
        "Return of the episodes that ended in each part of training: every policy, their mean and its 95 % bootstrap "
        "interval; actions are drawn. Lines: random actions and the optimal return with the simulator in use, "
        "which steps on with it (from the second recording on: on a rough grid). A control has no such return: "
        "whatever it chooses is as good as random.",
    ),
    "comparisons": (
        "comparisons",
        "Every point is a policy's mean return. Boxes: quartiles and median. * p < 0.05, ** p < 0.01, *** p < 0.001, "
        "two-sided Mann-Whitney U, normal approximation, corrected by Holm as in the table. Under each arm: "
        "(mean − random) / (optimal − random).",
    ),
    "over-time": (
        "at every recording",
        "The same policies on the simulator of each recording: median and quartiles over policies, with the "
        "optimal return. What falls with it is the simulator's: the culture's, and what its bins keep of it; what "
        "falls faster is the policy's. At every recording that return is on a rough grid, which can lie some below "
        "the fine one, and is left out for mappings without steps, such as `linear`.",
    ),
    "controls": (
        "controls",
        "Mean returns with standard errors over policies (for a control of one actor: over episodes), at the "
        "recordings of the comparisons.",
    ),
    "paths": (
        "episodes",
        "One episode of each policy at the last recording. Blue: it arrived, or stayed up to the end; orange: not.",
    ),
    "frames": ("frames", "From the start of an episode to its end; the number under a frame is the iteration."),
}
