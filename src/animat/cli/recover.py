"""The command that recovers what was recorded by a run that was killed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from animat.cli.command import Command
from animat.terminal_table import align_columns


@dataclass(frozen=True)
class Recover(Command):
    """Write the recording of a closed-loop session that was killed, from its log; or keep what a device had recorded
    when animat record or animat live was killed or found no room on the disk."""

    session: Positional[Path] = Path("session")
    """The session's folder, or one of recordings"""

    def run(self) -> dict[str, Any]:
        from animat.recordings.formats.npz import UNDER_WAY

        folders = [each for each in (self.session, self.session / "recordings") if (each / UNDER_WAY).exists()]
        return self._recording(folders[0]) if folders else self._session()

    def _recording(self, folder: Path) -> dict[str, Any]:
        from animat.cultures.under_way import INTERRUPTED, keep_interrupted
        from animat.writing import exclusive_lock

        before = set((folder / INTERRUPTED).glob("*"))
        with exclusive_lock(folder):
            keep_interrupted(folder)
        kept = sorted(set((folder / INTERRUPTED).glob("*")) - before)
        for file in kept:
            is_damaged = "; it is damaged, and kept as it is" if file.suffix == ".npz" else ""
            print(f"{file}: what the run before had recorded{is_damaged}")
        if not kept:
            print(f"{folder}: nothing to keep: the recording that was cut short can be made again")
        return {"recordings": [str(file) for file in kept]}

    def _session(self) -> dict[str, Any]:
        from animat.closed_loop.session import lost_message, recover_session, unanswered_message
        from animat.progress import Bar
        from animat.watch.tail import by_agent

        with Bar("reading the log") as progress:
            session = recover_session(self.session, progress)
        summary = session.to_dict()
        print(
            f"{session.recording_file} and {session.ticks_file.name}: {summary['ticks']} ticks, "
            f"{summary['pulses']} pulses; it ended: {summary['ended']}"
        )
        header = session.log.header
        names = [agent["name"] for agent in header["agents"]]
        agents = by_agent(names, session.episodes, header.get("predicted"))
        if rows := [_cells(**agent) for agent in agents]:
            head = ["", "predicted", "its 95 % interval", "measured", "whole episodes"]
            print("\n".join(align_columns(head, rows)))
            starts = {episode.start for episode in session.episodes}
            if header.get("predicted") and session.ending.by != "plan" and len(starts) > 1:
                print("  predicted: from the starts of all planned episodes; the measured ones had the first of them")
        if summary["unanswered_pulses"]:
            print(unanswered_message(session))
        if summary["lost_bytes"]:
            print(lost_message(summary["lost_bytes"]))
        return {"recording": str(session.recording_file), **summary, "agents": agents}


def _cells(name: str, n: int, mean: float | None, predicted: Sequence[float] | None, **_: Any) -> list[str]:
    """A row of the table: mean returns of an agent, as far as they are known."""
    value, *ends = ("-", "") if predicted is None else (f"{predicted[0]:.1f}", "{1:.1f} to {2:.1f}".format(*predicted))
    return [name, value, *ends, "-" if mean is None else f"{mean:.1f}", str(n)]
