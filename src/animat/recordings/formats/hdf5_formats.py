"""Which of the formats in HDF5 a file is, told by its layout, and read."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from animat.errors import InvalidArgument, InvalidFile
from animat.recordings.formats.cl1 import is_cl1, read_cl1
from animat.recordings.formats.hdf5 import Hdf5File, hdf5_file
from animat.recordings.formats.maxwell import is_maxwell, read_maxwell
from animat.recordings.formats.nwb import is_nwb, read_nwb
from animat.recordings.recording import Recording

Format = Literal["NWB", "MaxWell", "CL1"]


def format_of(file: Hdf5File) -> Format | None:
    """The format of an open file, None for one that is not known."""
    if is_nwb(file):
        return "NWB"
    if is_maxwell(file):
        return "MaxWell"
    return "CL1" if is_cl1(file) else None


def read_hdf5(path: Path, *, part: str | None = None, stimuli: str | None = None) -> Recording:
    """Read a recording in any of the formats.

    Args:
        part: which recording of a MaxWell file that holds several.
        stimuli: the name of the stimuli where several could be meant.

    Raises:
        InvalidFile: if the file is damaged, of no known format, or holds no recording.
        InvalidArgument: for a choice that the file's format does not offer.
    """
    with hdf5_file(path, "HDF5 recording") as file:
        found = format_of(file)
        if found is None:
            raise InvalidFile(
                f"{path}: expected NWB, MaxWell or CL1, got another HDF5 file (it holds: {file.held}); bring its "
                "columns as NPZ or CSV"
            )
    if part is not None and found != "MaxWell":
        raise InvalidArgument(f"part: expected only for MaxWell files, got {part!r} for one of {found}")
    if stimuli is not None and found == "CL1":
        raise InvalidArgument(f"stimuli: expected only for NWB and MaxWell files, got {stimuli!r} for one of {found}")
    if found == "NWB":
        return read_nwb(path, stimuli=stimuli)
    return read_maxwell(path, part=part, stimuli=stimuli) if found == "MaxWell" else read_cl1(path)
