"""A process that trains one group of policies until it is told to end: `python -m animat.live.worker CPU`.

The job comes pickled on standard input, from the process that records. Before each chunk the newest simulator is taken
from the exchange; progress and swaps go out as JSON lines.
"""

from __future__ import annotations

import json
import pickle
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any


def main() -> int:
    """Read a job, train until the exchange says to finish, write the policies."""
    from animat.training.worker import settle_on

    told = settle_on(int(sys.argv[1]))
    # Ctrl-C is for the process that records, which ends this one by the exchange.
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    from animat.compilation import keep_compilations
    from animat.errors import AnimatError
    from animat.live.exchange import Exchange
    from animat.robots.registry import register_robot
    from animat.training.group import Group, SideBySide

    keep_compilations()
    group: Group
    exchange: Exchange
    folder: Path
    keep_s: float

    def tell(**words: Any) -> None:
        print(json.dumps({"members": group.members, **words}), file=told, flush=True)

    try:
        group, exchange, folder, keep_s = pickle.load(sys.stdin.buffer)
        register_robot(type(group.training.robot))
        swaps: list[dict[str, Any]] = []
        # The policies tell what they were trained on, the last of it known only in the end.
        group = replace(group, provenance={**group.provenance, "swaps": swaps})
        together = SideBySide(group)
        number, simulator, index, kept_s = -1, None, 0, time.monotonic()

        def keep() -> None:
            for member, policy in zip(group.members, together.policies(), strict=True):
                policy.save(folder / f"p{member}.safetensors")

        while not (exchange.is_finished and index):
            newer = exchange.newest(number)
            if newer is not None:
                number, start_min, simulator = newer
                iterations = group.training.chunk(index)[0] * group.training.algorithm.environments
                swaps.append({"chunk": index, "iterations": iterations, "recorded_at_min": start_min})
                tell(swap=number, **swaps[-1])
            if simulator is None:
                raise AnimatError("live: expected a simulator in the exchange before training began, got none")
            mean_return = together.train(index, simulator)
            if time.monotonic() - kept_s > keep_s:
                keep()
                kept_s = time.monotonic()
            index += 1
            iterations = group.training.chunk(index)[0] * group.training.algorithm.environments
            tell(done=index, using=number, iterations=iterations, mean_return=mean_return)
        keep()
    except AnimatError as error:
        tell(error=str(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
