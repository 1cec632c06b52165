"""The layout of a recording in animat's own NWB, for writing and reading; docs/recordings.md describes it."""

FORMAT_VERSION = 1
"""Version of the tables below, written to every file; newer versions are refused."""

RECORDING = "processing/ecephys/animat_recording"
PROVENANCE = "processing/ecephys/animat_provenance"
UNITS = "units"
ELECTRODES = "general/extracellular_ephys/electrodes"
STIMULI = "stimulus/presentation/stimuli"

SUBJECT = {name: name for name in ("subject_id", "species", "sex", "age")} | {"description": "subject_description"}
"""NWB's fields of a subject, and their keys in a recording's provenance."""
