"""The channels of a CL1, which its driver and its files share: 59 electrodes among 64 numbers."""

CHANNELS = 64
NO_STIMULATION = {0: "ground", 4: "reference", 7: "ground", 56: "ground", 63: "ground"}
"""Channels that are no electrodes, neither to stimulate nor to record, and what they are. The SDK says nothing of a
stimulus on them: version 1.0.0 leaves the ground channels out in silence, and its simulator does as if the reference
could stimulate."""
SITES = tuple(channel for channel in range(CHANNELS) if channel not in NO_STIMULATION)
STIMULUS_STREAM = "animat_stimuli"
"""The data stream that animat's driver keeps the stimuli's parameters in: the SDK's own recording knows none."""
