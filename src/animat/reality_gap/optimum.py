"""The optimal return on a closed loop's simulator, computed while the loop runs."""

from __future__ import annotations

import threading
from concurrent.futures import Future
from typing import Any

from animat.environment import Animat
from animat.evaluation.optimum import optimal_values
from animat.neurons.simulator import NeuronSimulator
from animat.progress import Progress, in_phase
from animat.robots.grid import grid_for

RESOLUTION = 0.5
"""Of the grid: fast and coarse, with an error of 0.8 on the range of 200 of the cartpole."""


def begin_optimum(environment: Animat[Any], simulator: NeuronSimulator) -> Future[float]:
    """The optimal return, computed in a background thread, on another core than a loop without deadlines."""
    optimum: Future[float] = Future()

    def work() -> None:
        try:
            # Only the value, which is reported as "about": its uncertainty would take a third longer.
            grid = grid_for(environment.robot).scaled(RESOLUTION)
            (value,), _ = optimal_values([(environment, simulator)], grid, seed=1)
            optimum.set_result(float(value))
        except BaseException as error:
            optimum.set_exception(error)

    # A daemon, so that a user who stops the program need not wait for it.
    threading.Thread(target=work, name="optimal return", daemon=True).start()
    return optimum


def wait_for_optimum(optimum: Future[float], progress: Progress | None) -> float:
    """Wait for the value, or raise the error because of which it could not be computed."""
    if not optimum.done():
        in_phase(progress, "optimal return").update(0, 1, "computing it on the simulator")
    return optimum.result()
