"""The optimal return of what a closed loop acts in, worked out beside it."""

from __future__ import annotations

import threading
from concurrent.futures import Future, wait
from typing import Any

from animat.environment import Animat
from animat.evaluation.optimum import rough_values
from animat.neurons.simulator import NeuronSimulator
from animat.progress import Progress, in_phase
from animat.robots.grid import grid_for

RESOLUTION = 0.5
"""Of the grid: fast and rough, 0.8 of the cartpole's 200."""


class BackgroundOptimum:
    """The optimal return, computed in a thread: beside a loop that takes what time it takes, on another core."""

    def __init__(self, environment: Animat[Any], simulator: NeuronSimulator) -> None:
        self._found: Future[float] = Future()

        def work() -> None:
            try:
                self._found.set_result(_best_return(environment, simulator))
            except BaseException as error:
                self._found.set_exception(error)

        # A daemon: whoever stops while it computes need not wait for it.
        threading.Thread(target=work, name="optimal return", daemon=True).start()

    @property
    def is_known(self) -> bool:
        """Whether nobody would wait for it; also where it could not be computed."""
        return self._found.done()

    def value(self, progress: Progress | None) -> float:
        """Wait for it.

        Raises:
            Exception: what kept it from being computed.
        """
        if not self._found.done():
            in_phase(progress, "optimal return").update(0, 1, "working it out on the simulator")
        return self._found.result()

    def join(self) -> None:
        """Wait until it computes no more: a program that ends while JAX computes in a thread is ended by a signal."""
        wait([self._found])


def _best_return(environment: Animat[Any], simulator: NeuronSimulator) -> float:
    """The value alone, which is told as "about": how well it is known would take a third as long again."""
    grid = grid_for(environment.robot).scaled(RESOLUTION)
    (value,), _ = rough_values([(environment, simulator)], grid, seed=1)
    return float(value)
