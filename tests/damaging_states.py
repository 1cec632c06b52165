"""Change a virtual culture's state in every way that a hand or a fault could, and go on from it, in one process.

    python damaging_states.py FOLDER EVERY

Every array and every number of the description is given another type, another shape, values from outside and values
that are none. Ends with another status than 0 at the first file that is neither refused in one line nor gone on from
within seconds: a traceback, an index into somebody else's memory, a clock that is waited for.
"""

from __future__ import annotations

import copy
import json
import signal
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from animat.cultures.virtual import VirtualCulture
from animat.errors import InvalidFile, Mismatch
from cultures import small_culture

SECONDS = 5
NUMBERS = (None, True, 1.5, -1, 10**9, 10**18, 2**63, -(2**70), float("nan"), float("inf"), "1", [], {}, [[[]]])


def arrays_changed(name: str, array: np.ndarray[Any, Any]) -> Iterator[tuple[str, Any]]:
    """Other arrays in the place of one."""
    for dtype in ("f8", "f4", "i8", "i4", "u1", ">i8", ">f4", "c16", "S3", "?"):
        if np.dtype(dtype) != array.dtype:
            yield f"as {dtype}", array.astype("f8").astype(dtype) if array.dtype.kind != "U" else array.astype("S")
    yield "empty", array[..., :0] if array.ndim else np.zeros(0)
    yield "one too many", np.concatenate([array, array[:1]]) if array.ndim else np.array([array, array])
    yield "in a row", array[None]
    yield "of the other order", np.asfortranarray(np.stack([array, array]))
    if array.dtype.kind in "iuf":
        grown = array if array.size else np.zeros(1, array.dtype)
        extremes = [np.iinfo(array.dtype).max, np.iinfo(array.dtype).min, -1, 300] if array.dtype.kind == "i" else [
            np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-45]  # fmt: skip
        for value in extremes:
            for place in (0, -1):
                changed = grown.copy()
                changed.flat[place] = value
                yield f"{value} at {place}", changed
            yield f"{value} all over", np.full_like(grown, value)


def heads_changed(head: dict[str, Any], at: tuple[Any, ...] = ()) -> Iterator[tuple[str, dict[str, Any]]]:
    """Other descriptions in the place of one: every value in it is left out or becomes something else."""
    node: Any = head
    for key in at:
        node = node[key]
    keys = list(node) if isinstance(node, dict) else range(min(len(node), 1)) if isinstance(node, list) else []
    for key in keys:
        for value in ("left out", *NUMBERS):
            changed = copy.deepcopy(head)
            inner: Any = changed
            for step in at:
                inner = inner[step]
            if value == "left out":
                del inner[key]
            else:
                inner[key] = value
            yield f"{(*at, key)} {value!r}", changed
        yield from heads_changed(head, (*at, key))


def files(whole: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """What one changed file after the other holds."""
    head = json.loads(str(whole["head"]))
    for name, array in whole.items():
        for what, changed in arrays_changed(name, array):
            yield f"{name} {what}", whole | {name: changed}
        yield f"no {name}", {other: values for other, values in whole.items() if other != name}
    # Kicks and held spikes belong together: as many of each.
    for neuron in (-1, 300, 2**40):
        for step in (-1, 0, head["tissue_step"]):
            kick = {"kicks_step": [step], "kicks_neuron": [neuron], "kicks_mv": np.ones(1, np.float32)}
            yield f"kick of {neuron} at {step}", whole | kick
        yield f"held {neuron}", whole | {"held_ns": [head["now_ns"]], "held_neuron": [neuron]}
    for what, changed in heads_changed(head):
        yield f"head {what}", whole | {"head": json.dumps(changed)}
    for text in ("", "{}", "null", "[" * 100_000, '{"format": ' + "9" * 5000 + "}"):
        yield f"head {text[:20]}", whole | {"head": text}
    yield "an array more", whole | {"more": np.zeros(2)}
    for name in ("head", "held_ns", "state_v_mv"):
        yield f"{name} without end", whole | {name: None}


def write(path: Path, arrays: dict[str, Any]) -> None:
    """Write a file; None becomes an array that claims far more than it holds, and holds more than it should."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                if values is not None:
                    np.lib.format.write_array(member, np.asanyarray(values))
                    continue
                claimed = {"descr": "<i8", "fortran_order": False, "shape": (2**40,)}
                np.lib.format.write_array_header_1_0(member, claimed)  # type: ignore[no-untyped-call]
                member.write(bytes(2**25))


def main(folder: Path, every: int) -> None:
    """Change and go on, with one in so many."""
    path = folder / "culture.state"
    with small_culture() as culture:
        culture.deliver([], 0.01013)
        culture.save_state(path, sessions=1)
    # Growing a tissue takes longer than all else; what is restored replaces all of its state.
    grown = small_culture()._grown()

    def again() -> VirtualCulture:
        culture = small_culture()
        culture._grown = lambda: grown  # type: ignore[method-assign]
        return culture

    with np.load(path) as file:
        whole = dict(file)
    again().restore_state(path)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    refused = gone_on = 0
    for number, (what, arrays) in enumerate(files(whole)):
        if number % every:
            continue
        write(folder / "changed.state", arrays)
        (folder / "last").write_text(what)
        signal.alarm(SECONDS)
        culture = again()
        try:
            culture.restore_state(folder / "changed.state")
        except (InvalidFile, Mismatch) as error:
            refused += 1
            if "\n" in str(error) or "changed.state" not in str(error) or len(str(error)) > 600:
                raise RuntimeError(f"not one line: {error!r}") from error
        else:
            gone_on += 1
            with culture:
                culture.deliver([], 0.02)
        signal.alarm(0)
    print(f"{refused} refused, {gone_on} gone on from")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
