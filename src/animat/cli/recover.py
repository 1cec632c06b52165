"""The command that recovers the recording of a session that was killed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from animat.cli.command import Command


@dataclass(frozen=True)
class Recover(Command):
    """Write the recording of a closed-loop session that was killed, from its log."""

    session: Positional[Path] = Path("session")
    """The session's folder"""

    def run(self) -> dict[str, Any]:
        from animat.closed_loop.session import lost_message, recover_session, unanswered_message
        from animat.progress import Bar

        with Bar("reading the log") as progress:
            session = recover_session(self.session, progress)
        summary = session.to_dict()
        print(
            f"{session.recording_file} and {session.ticks_file.name}: {summary['ticks']} ticks, "
            f"{summary['pulses']} pulses; it ended: {summary['ended']}"
        )
        if summary["unanswered_pulses"]:
            print(unanswered_message(session))
        if summary["lost_bytes"]:
            print(lost_message(summary["lost_bytes"]))
        return {"recording": str(session.recording_file), **summary}
