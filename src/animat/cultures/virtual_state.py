"""The state of a virtual culture as a file, so that an interrupted series of recordings continues bit for bit."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int64

from animat.cultures.tissue import Tissue
from animat.cultures.tissue.coupling import Kicks
from animat.cultures.tissue.kernel import TissueState
from animat.cultures.tissue.snapshot import LONGEST_NS, Snapshot, expect_array, expect_rising, expect_whole
from animat.errors import InvalidArgument, InvalidFile, Mismatch, shown
from animat.stimulation.array import MAXONE
from animat.stimulation.selection import Selection
from animat.writing import atomic_write

FORMAT = "animat virtual culture state 1"
_HELD = ("held_ns", "held_neuron")
_MOST_BYTES, _HEADER_BYTES = 2**24, 2**10
"""Largest size of an array whose length the tissue does not determine, and of the header that numpy writes."""
_AHEAD_NS = 1_000_000_000
"""Limit on how far the tissue is ahead of the culture's clock: a step for each pulse within a step."""


class VirtualState(NamedTuple):
    """The complete state of a virtual culture of known settings; all times are on the tissue's clock."""

    selection: Selection
    zero_ns: int
    now_ns: int
    held_ns: Int64[np.ndarray, " held"]
    held_neuron: Int64[np.ndarray, " held"]
    snapshot: Snapshot
    remarks: Mapping[str, int]


def write_state(path: str | os.PathLike[str], settings: Mapping[str, str], state: VirtualState) -> None:
    """Write the state of a culture of these settings; see `VirtualCulture.save_state`."""
    snapshot = state.snapshot
    head: dict[str, Any] = {"format": FORMAT, "culture": dict(settings), "selection": state.selection.to_dict()}
    head |= {"zero_ns": state.zero_ns, "now_ns": state.now_ns, "tissue_now_ns": snapshot.now_ns}
    head |= {"tissue_step": snapshot.step, "remarks": dict(state.remarks)}
    arrays = {f"state_{name}": values for name, values in snapshot.state._asdict().items()}
    arrays |= {f"kicks_{name}": values for name, values in snapshot.kicks._asdict().items()}
    held = {name: getattr(state, name) for name in _HELD}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, head=np.array(json.dumps(head)), **held, **arrays)


def read_state(path: Path, settings: Mapping[str, str], tissue: Tissue) -> VirtualState:
    """Read the state of a culture of these settings into its new tissue; see `VirtualCulture.restore_state`."""
    fresh = tissue.snapshot()
    lengths = {f"state_{name}": values.nbytes for name, values in fresh.state._asdict().items()}
    lengths |= dict.fromkeys((*(f"kicks_{name}" for name in Kicks._fields), *_HELD, "head"), _MOST_BYTES)
    try:
        # Opened here, because numpy leaves a damaged file open.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            _expect_members(file.zip, lengths)
            arrays = {name: file[name] for name in file.files}
        head = json.loads(str(arrays.pop("head")))
        if head["format"] != FORMAT:
            raise InvalidArgument(f"format {shown(head['format'])}")
        for name, value in settings.items():
            if head["culture"].get(name) != value:
                remedy = "use the same settings, or start another culture in another folder"
                if name == "tissue_revision":
                    remedy = "continue with the version of animat that wrote it, or start again in another folder"
                raise Mismatch(f"{path}: expected the state of this culture, got one which differs in {name}: {remedy}")
        kicks = Kicks(*(arrays[f"kicks_{name}"] for name in Kicks._fields))
        saved = TissueState(*(arrays[f"state_{name}"] for name in TissueState._fields))
        clock = head["tissue_now_ns"], head["tissue_step"]
        snapshot = Snapshot(tissue.seed, tissue.parameters, *clock, kicks, saved)
        # First, because the other clocks are checked against the tissue's.
        tissue.restore(snapshot)
        zero_ns, now_ns, remarks = head["zero_ns"], head["now_ns"], head["remarks"]
        expect_whole("now_ns", now_ns, max(0, snapshot.now_ns - _AHEAD_NS), snapshot.now_ns)
        expect_whole("zero_ns", zero_ns, 0, now_ns)
        for name, remark in remarks.items():
            expect_whole(f"remarks.{shown(name)}", remark, 0, LONGEST_NS)
        held_ns, held_neuron = (arrays[name] for name in _HELD)
        expect_array("held_ns", held_ns, np.int64, (len(held_ns),), (now_ns, snapshot.now_ns))
        expect_array("held_neuron", held_neuron, np.int64, (len(held_ns),), (0, len(fresh.state.v_mv) - 1))
        expect_rising("held_ns", held_ns)
        selection = Selection.from_dict(head["selection"])
        if selection.array != MAXONE:
            raise InvalidArgument(f"selection.array: expected the {MAXONE.name}'s, got {shown(selection.array)}")
    except Mismatch:
        raise
    except Exception as error:  # numpy, zipfile and zlib have a dozen kinds of errors for a damaged archive
        reason = f" ({error})" if isinstance(error, InvalidArgument) else ""
        what = f"it is damaged or something else{reason}: choose another, or move it away to start again"
        raise InvalidFile(f"{path}: expected the whole state of a virtual culture, but {what}") from error
    return VirtualState(selection, zero_ns, now_ns, held_ns, held_neuron, snapshot, remarks)


def _expect_members(archive: zipfile.ZipFile, lengths: Mapping[str, int]) -> None:
    sizes = [(member.filename, member.file_size) for member in archive.infolist()]
    if sorted(name for name, _ in sizes) != sorted(f"{name}.npy" for name in lengths):
        raise ValueError("the arrays are not those of a state")
    for name, size in sizes:
        if size > lengths[name.removesuffix(".npy")] + _HEADER_BYTES:
            raise ValueError(f"{name} has {size:,} bytes")
