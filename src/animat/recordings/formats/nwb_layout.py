"""The layout of a recording in animat's own NWB, for writing and reading; docs/recordings.md describes it."""

from animat.errors import InvalidArgument

FORMAT_VERSION = 1
"""Version of the tables below, written to every file; newer versions are refused."""

RECORDING = "processing/ecephys/animat_recording"
PROVENANCE = "processing/ecephys/animat_provenance"
UNITS = "units"
ELECTRODES = "general/extracellular_ephys/electrodes"
STIMULI = "stimulus/presentation/stimuli"

SUBJECT = {name: name for name in ("subject_id", "species", "sex", "age")} | {"description": "subject_description"}
"""NWB's fields of a subject, and their keys in a recording's provenance."""


def expect_hdf5_text(name: str, text: object) -> str:
    """The text, if HDF5 can hold it; raises InvalidArgument if not."""
    text = str(text)
    if "\0" in text or any("\ud800" <= character <= "\udfff" for character in text):
        raise InvalidArgument(f"{name}: expected text without null characters or lone surrogates, got {text!r}")
    return text
