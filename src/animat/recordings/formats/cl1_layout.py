"""The channels of a CL1, shared by its driver and its file format: 59 electrodes among 64 channels."""

CHANNELS = 64
NO_STIMULATION = {0: "ground", 4: "reference", 7: "ground", 56: "ground", 63: "ground"}
"""Channels that are not electrodes, neither for stimulation nor for recording, and what they are. The SDK does not
refuse a stimulus on them: version 1.0.0 silently drops it on ground, and its simulator lets the reference stimulate."""
IDENTIFIERS = ("system_id", "chip_id", "cell_batch_id", "project_id")
"""The device's attributes that say which one it is and what is on it; its recordings have them too."""
STAND_IN = "cl-sdk"
"""What the SDK's simulator writes as any of them, which names no culture."""
SITES = tuple(channel for channel in range(CHANNELS) if channel not in NO_STIMULATION)
STIMULUS_STREAM = "animat_stimuli"
"""The data stream in which animat's driver stores the stimuli's parameters, which the SDK's recording lacks."""
