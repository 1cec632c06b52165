"""The state of a virtual culture as a file, so that a series of recordings goes on bit for bit when interrupted."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from animat.errors import InvalidFile, Mismatch
from animat.recordings.selection import Selection
from animat.writing import written_whole

if TYPE_CHECKING:
    from animat.cultures.virtual import VirtualCulture

FORMAT = "animat virtual culture state 1"


def write_state(culture: VirtualCulture, path: str | os.PathLike[str], remarks: Mapping[str, int]) -> None:
    """Write the state; see `VirtualCulture.save_state`."""
    snapshot = culture.tissue.snapshot()
    head = {
        "format": FORMAT,
        "culture": culture.settings,
        "selection": culture.selection.to_dict(),
        "zero_ns": culture._zero_ns,
        "now_ns": culture._now_ns,
        "tissue_now_ns": snapshot.now_ns,
        "tissue_step": snapshot.step,
        "remarks": dict(remarks),
    }
    arrays = {f"state_{name}": values for name, values in snapshot.state._asdict().items()}
    arrays |= {f"kicks_{name}": values for name, values in snapshot.kicks._asdict().items()}
    with written_whole(path) as beside, beside.open("wb") as file:
        np.savez_compressed(
            file,
            head=np.array(json.dumps(head)),
            held_ns=culture._held_ns,
            held_neuron=culture._held_neuron,
            **arrays,
        )


def read_state(culture: VirtualCulture, path: str | os.PathLike[str]) -> dict[str, int]:
    """Put a state into a culture; see `VirtualCulture.restore_state`."""
    from animat.cultures.tissue.coupling import Kicks
    from animat.cultures.tissue.kernel import State
    from animat.cultures.tissue.tissue import Snapshot

    head, arrays = _read(Path(path))
    for name, value in culture.settings.items():
        if head["culture"].get(name) != value:
            again = "remove it to begin anew, or use the same settings"
            if name == "tissue_revision":
                again = "that version of animat goes on with it, this one from the beginning (remove it)"
            raise Mismatch(
                f"{path}: expected the state of this culture, got another's, which differs in {name}: {again}"
            )
    tissue, visibility = culture._grown()
    try:
        fresh = tissue.snapshot()
        snapshot = Snapshot(
            seed=tissue.seed,
            parameters=tissue.parameters,
            now_ns=head["tissue_now_ns"],
            step=head["tissue_step"],
            kicks=Kicks(*(arrays[f"kicks_{name}"] for name in Kicks._fields)),
            state=State(*(_like(arrays[f"state_{n}"], getattr(fresh.state, n)) for n in State._fields)),
        )
        selection = Selection.from_dict(head["selection"])
        held_ns, held_neuron = arrays["held_ns"].astype(np.int64), arrays["held_neuron"].astype(np.int64)
        zero_ns, now_ns, remarks = int(head["zero_ns"]), int(head["now_ns"]), dict(head["remarks"])
    except (KeyError, ValueError, TypeError) as error:
        raise InvalidFile(
            f"{path}: expected the state of a virtual culture of this version, got {error!r}: remove it to begin anew"
        ) from error
    tissue.restore(snapshot)
    # Only now: a culture that could not be restored is what it was.
    culture._have(tissue, visibility)
    culture._selection = selection
    culture._zero_ns, culture._now_ns = zero_ns, now_ns
    culture._held_ns, culture._held_neuron = held_ns, held_neuron
    return remarks


def _like(values: np.ndarray[Any, Any], example: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    if values.shape != example.shape or values.dtype != example.dtype:
        raise ValueError(f"an array of shape {values.shape} where one of shape {example.shape} belongs")
    return values


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray[Any, Any]]]:
    try:
        # Opened here, because numpy leaves a damaged file open.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        head = json.loads(str(arrays.pop("head")))
        if head["format"] != FORMAT or not isinstance(head["culture"], dict):
            raise ValueError(f"format {head['format']!r}")
    except FileNotFoundError as error:
        raise InvalidFile(f"{path}: no such file") from error
    except Exception as error:  # numpy, zipfile and zlib have a dozen kinds of errors for a damaged archive
        raise InvalidFile(
            f"{path}: expected the whole state of a virtual culture, but it is damaged or something else; "
            "give another, or move it away to begin anew"
        ) from error
    return head, arrays
