"""The kinds of cultures by name."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from animat.cultures.base import Culture
from animat.errors import InvalidArgument, expect_at_least
from animat.progress import Progress
from animat.recordings.recording import Recording
from animat.stimulation.pulse import BALANCED_PULSE, PUBLISHED_PULSE, Pulse

CultureKind = Literal["virtual", "replay", "cl1", "maxone"]


def culture_named(
    kind: CultureKind,
    *,
    seed: int = 1,
    state: str | os.PathLike[str] | None = None,
    recordings: Sequence[Recording] = (),
    selection: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> Culture:
    """A culture of a kind, closed.

    Args:
        seed: selects a virtual culture, the draws of a replay, or a CL1's patterns. 0 or more.
        state: of a virtual culture, from which to continue (`VirtualCulture.save_state`).
        recordings: from which a replay answers.
        selection: file with the electrodes of a MaxOne (`Selection.save`).
        progress: updated during a virtual culture's scan.
    """
    expect_at_least("seed", seed, 0)
    for name, value, taken_by in (("state", state, "virtual"), ("selection", selection, "maxone")):
        if value is not None and kind != taken_by:
            raise InvalidArgument(f"{name}: expected none for a culture of kind {kind!r}, got {value}")
    if kind == "virtual":
        from animat.cultures.virtual import VirtualCulture

        culture = VirtualCulture(seed, progress=progress)
        if state is not None:
            culture.restore_state(state)
        return culture
    if kind == "replay":
        from animat.cultures.replay import ReplayCulture

        return ReplayCulture(recordings, seed=seed)
    if kind == "cl1":
        from animat.cultures.devices.cl1 import CL1Culture

        return CL1Culture(seed=seed)
    if kind == "maxone":
        from animat.cultures.devices.maxone import MaxOneCulture
        from animat.stimulation.selection import Selection

        if selection is None:
            raise InvalidArgument("selection: expected a file of electrodes for a culture of kind 'maxone', got none")
        return MaxOneCulture(Selection.load(selection))
    raise InvalidArgument(f"culture: expected one of {', '.join(get_args(CultureKind))}, got {kind!r}")


def pulse_for(kind: str, recorded: Pulse | None = None) -> Pulse:
    """The pulse for a kind of culture (`CultureKind`): the recorded one, or by default the usual one.

    A replay responds alike to every pulse, and its limits are those of voltages.
    """
    if recorded is not None and (kind != "replay" or recorded.kind == PUBLISHED_PULSE.kind):
        return recorded
    if kind == "cl1":
        from animat.cultures.devices.cl1 import CL1_PULSE

        return CL1_PULSE
    # The published pulse as printed is not balanced: a living culture gets one that is.
    return BALANCED_PULSE if kind == "maxone" else PUBLISHED_PULSE


def culture_arguments(kind: CultureKind, recordings: Sequence[Recording], files: Sequence[Path]) -> dict[str, Any]:
    """Arguments of `culture_named` that recreate the recorded culture, as far as they are known.

    For a virtual culture its seed, and the state written after the recordings; for a CL1 the seed of its patterns.
    """
    culture = recordings[0].culture if recordings else None
    if culture is None or culture.kind != kind or culture.seed is None:
        return {}
    arguments: dict[str, Any] = {"seed": culture.seed}
    if kind == "virtual":
        from animat.cultures.series import STATE_FILE

        folders = [file if file.is_dir() else file.parent for file in files]
        # Each folder once, however it is spelled.
        distinct = {folder.resolve(): folder for folder in folders}.values()
        states = [folder / STATE_FILE for folder in distinct if (folder / STATE_FILE).is_file()]
        if len(states) == 1:
            arguments["state"] = states[0]
    return arguments
