"""Where a recording stands in animat's own NWB, for whoever writes it and whoever reads it.

/units                         one unit a channel, silent ones included: spike_times, obs_intervals, electrodes
/general/extracellular_ephys   /electrodes: label, electrode_id, rel_x, rel_y (um); one row a channel
                               (both are absent where a recording has no channel)
/stimulus/presentation/stimuli TimeIntervals, one row a pulse: start_time, frequency_hz, pattern, presentation,
                               electrode_ids (ragged: ids on the array, which need not be recorded electrodes;
                               absent where none is known)
/processing/ecephys            /animat_recording: one row, the scalars of `Recording` and its presentation;
                               /animat_provenance: one row a key (absent where there is none)
"""

FORMAT_VERSION = 1
"""Of the tables above; written into every file, and a newer one is refused."""

RECORDING_TABLE = "processing/ecephys/animat_recording"
PROVENANCE_TABLE = "processing/ecephys/animat_provenance"
UNITS_TABLE = "units"
ELECTRODES_TABLE = "general/extracellular_ephys/electrodes"
STIMULI_TABLE = "stimulus/presentation/stimuli"

SUBJECT = {name: name for name in ("subject_id", "species", "sex", "age")} | {"description": "subject_description"}
"""NWB's fields of a subject, and where a recording's provenance has them."""
