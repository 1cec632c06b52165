"""The command that makes a recording of a session that was killed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional


@dataclass(frozen=True)
class Recover:
    """Write the recording of a closed-loop session that was killed, from its log."""

    session: Positional[Path] = Path("session")
    """The session's folder"""
    json: bool = False
    """End with a line of JSON"""

    def run(self) -> dict[str, Any]:
        """Recover."""
        from animat.closed_loop.session import recover_session, told_lost, told_unanswered
        from animat.progress import Bar

        with Bar("reading the log") as progress:
            session = recover_session(self.session, progress)
        told = session.to_dict()
        print(
            f"{session.recording_file} and {session.ticks_file.name}: {told['ticks']} ticks, {told['pulses']} pulses; "
            f"it ended: {told['ended']}"
        )
        if told["unanswered_pulses"]:
            print(told_unanswered(session))
        if told["lost_bytes"]:
            print(told_lost(told["lost_bytes"]))
        return {"recording": str(session.recording_file), **told}
