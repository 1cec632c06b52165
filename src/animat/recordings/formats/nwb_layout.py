"""The layout of a recording in animat's own NWB, for writing and reading.

/units                         one unit per channel, including silent ones: spike_times, obs_intervals, electrodes
/general/extracellular_ephys   /electrodes: label, electrode_id, rel_x, rel_y (um); one row per channel
                               (both are absent if a recording has no channels)
/stimulus/presentation/stimuli TimeIntervals, one row per pulse: start_time, frequency_hz, pattern, presentation,
                               electrode_ids (ragged: ids on the array, which need not be recorded electrodes;
                               absent if none is known)
/processing/ecephys            /animat_recording: one row, the scalars of `Recording` and its presentation;
                               /animat_provenance: one row per key (absent if there is none)
"""

FORMAT_VERSION = 1
"""Version of the tables above, written to every file; newer versions are refused."""

RECORDING_TABLE = "processing/ecephys/animat_recording"
PROVENANCE_TABLE = "processing/ecephys/animat_provenance"
UNITS_TABLE = "units"
ELECTRODES_TABLE = "general/extracellular_ephys/electrodes"
STIMULI_TABLE = "stimulus/presentation/stimuli"

SUBJECT = {name: name for name in ("subject_id", "species", "sex", "age")} | {"description": "subject_description"}
"""NWB's fields of a subject, and their keys in a recording's provenance."""
