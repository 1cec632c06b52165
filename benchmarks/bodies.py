"""How fast a third-party body is trained on one core, compared with stable-baselines3's SAC to the same return.

    python benchmarks/bodies.py [--bodies Pendulum-v1=-200 Reacher-v5=-8] [--cap-s 300] [--json results.json]

Every measurement runs in its own process, pinned to one core before anything is imported. Times are processor seconds,
as other work may run on the machine, without compilation and evaluation. Reacher needs the extra `[mujoco]`; the peer
is left out if stable-baselines3 is not installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

EPISODES = 20
"""Episodes per evaluation, with the most probable action at each step."""

HELD = 2
"""Consecutive evaluations that must reach the return on average: one alone may be luck."""


def main() -> int:
    """Run all parts, or in a child process one of them, and print the table."""
    parser = argparse.ArgumentParser(description="How fast third-party bodies are trained, against stable-baselines3.")
    parser.add_argument("--bodies", nargs="+", default=["Pendulum-v1=-200", "Reacher-v5=-8"], metavar="ID=RETURN")
    parser.add_argument("--cap-s", type=float, default=300.0, help="processor seconds after which training is cut off")
    parser.add_argument("--core", type=int, default=max(os.sched_getaffinity(0)))
    parser.add_argument("--json", metavar="FILE", help="write all measurements to a file")
    parser.add_argument("--part", choices=sorted(PARTS), help=argparse.SUPPRESS)
    options = parser.parse_args()
    wanted = {name: float(value) for name, _, value in (each.partition("=") for each in options.bodies)}
    if options.part:
        os.sched_setaffinity(0, {options.core})
        ((id, return_),) = wanted.items()
        print(json.dumps(PARTS[options.part](id, return_, options.cap_s)))
        return 0
    measured: dict[str, dict[str, Any]] = {}
    for id, return_ in wanted.items():
        measured[id] = {}
        for part in PARTS:
            if part == "stable-baselines3" and importlib.util.find_spec("stable_baselines3") is None:
                continue
            command = [sys.executable, __file__, "--part", part, "--core", str(options.core)]
            command += ["--cap-s", str(options.cap_s), "--bodies", f"{id}={return_}"]
            ran = subprocess.run(command, capture_output=True, text=True, check=False)
            if ran.returncode:
                raise SystemExit(f"{id}, {part}: {ran.stderr.strip().splitlines()[-1]}")
            measured[id][part] = json.loads(ran.stdout.splitlines()[-1])
        print("\n".join(_lines(id, return_, measured[id])), flush=True)
    if options.json:
        Path(options.json).write_text(json.dumps(measured, indent=2) + "\n")
    return 0


def _lines(id: str, wanted: float, parts: dict[str, Any]) -> list[str]:
    lines = []
    for part, figures in parts.items():
        reached = f"{wanted:g} held after" if figures["held"] else f"{wanted:g} not held in"
        lines.append(
            f"{id}, {part}: {figures['iterations'] / figures['training_s']:,.0f} iterations/s; mean return {reached} "
            f"{figures['training_s']:.1f} s and {figures['iterations']:,} iterations "
            f"(best {max(figures['returns']):.1f})"
        )
    if len(parts) > 1:
        ours, peer = parts["animat"], parts["stable-baselines3"]
        least = "" if peer["held"] else "more than "
        lines.append(f"{id}: {least}{peer['training_s'] / ours['training_s']:.1f} times as fast")
    return lines


def _mean_return(id: str, act: Callable[[Any], Any]) -> float:
    """Mean return over the same episodes for both, in Gymnasium's own environment."""
    import gymnasium

    env, returns = gymnasium.make(id), []
    for seed in range(EPISODES):
        observation, _ = env.reset(seed=seed)
        total, is_over = 0.0, False
        while not is_over:
            observation, reward, terminated, truncated, _ = env.step(act(observation))
            total, is_over = total + float(reward), terminated or truncated
        returns.append(total)
    return sum(returns) / len(returns)


class _Watch:
    """Processor seconds of training alone, and the returns of the evaluations."""

    def __init__(self, wanted: float, cap_s: float) -> None:
        self.wanted, self.cap_s = wanted, cap_s
        self.returns: list[float] = []
        self.training_s, self.resumed = 0.0, time.process_time()

    def is_over(self, evaluate: Callable[[], float]) -> bool:
        self.training_s += time.process_time() - self.resumed
        self.returns.append(evaluate())
        self.resumed = time.process_time()
        return self.is_held or self.training_s > self.cap_s

    @property
    def is_held(self) -> bool:
        last = self.returns[-HELD:]
        return len(last) == HELD and sum(last) / HELD >= self.wanted

    def to_dict(self, iterations: int) -> dict[str, Any]:
        return {
            "training_s": self.training_s,
            "iterations": iterations,
            "held": self.is_held,
            "returns": self.returns,
        }


def animat(id: str, wanted: float, cap_s: float) -> dict[str, Any]:
    """Our SAC: one policy without neurons, with default settings, evaluated every 3,200 iterations."""
    import numpy as np

    from animat.robots import robot_named
    from animat.training.group import Group, SideBySide
    from animat.training.specification import CHUNKS, Training

    robot = robot_named(f"gymnasium:{id}")
    training = Training(robot, None, policies=1, iterations=CHUNKS * 3_200)
    together = SideBySide(Group(training, (0,), None, "benchmark", {}))
    # Compiles, in a training run that is thrown away.
    began = time.process_time()
    SideBySide(Group(training, (1,), None, "benchmark", {})).train(0, None)
    compiling_s = time.process_time() - began
    body: Any = robot.body()  # type: ignore[attr-defined]
    watch, index = _Watch(wanted, cap_s), 0
    while True:
        together.train(index, None)
        index += 1
        (policy,) = together.policies()

        def act(observation: Any, policy: Any = policy) -> Any:
            action = robot.actions(np.reshape(policy.act_greedily(observation), (1, -1)))[0]  # type: ignore[attr-defined]
            return np.asarray(action, body._dtype)

        if watch.is_over(lambda: _mean_return(id, act)):
            return watch.to_dict(index * 3_200) | {"compiling_s": compiling_s}


def stable_baselines3(id: str, wanted: float, cap_s: float) -> dict[str, Any]:
    """stable-baselines3's SAC with its defaults, evaluated every 500 steps."""
    import gymnasium
    import torch
    from stable_baselines3 import SAC
    from stable_baselines3.common.callbacks import BaseCallback

    torch.set_num_threads(1)
    watch = _Watch(wanted, cap_s)

    class Watching(BaseCallback):  # type: ignore[misc]
        def _on_step(self) -> bool:
            if self.num_timesteps % 500:
                return True
            return not watch.is_over(lambda: _mean_return(id, lambda o: self.model.predict(o, deterministic=True)[0]))

    model = SAC("MlpPolicy", gymnasium.make(id), seed=1)
    watch.resumed = time.process_time()
    model.learn(10_000_000, callback=Watching())
    return watch.to_dict(model.num_timesteps)


PARTS: dict[str, Callable[[str, float, float], dict[str, Any]]] = {
    "animat": animat,
    "stable-baselines3": stable_baselines3,
}

if __name__ == "__main__":
    sys.exit(main())
