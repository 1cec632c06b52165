"""The command that lists the robots: what each observes and what it can do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tyro.conf import Positional

from animat.cli.command import Command, robot_for


@dataclass(frozen=True)
class Robots(Command):
    """List the robots that can be trained: what each observes, its parameters, and what it lacks."""

    names: Positional[tuple[str, ...]] = ()
    """Robots to list, such as cartpole or my_package.robots:Rover; default: all registered robots"""

    def run(self) -> dict[str, Any]:
        from animat.errors import AnimatError, InvalidArgument
        from animat.robots.registry import REGISTRY

        listed, unusable = {}, {}
        for name in self.names or REGISTRY.names():
            try:
                listed[name] = _describe(name)
            except Exception as error:
                # Another package's robot may raise anything. Unless it was named, the other robots are still listed.
                message = f"{name}: expected a robot, got {type(error).__name__}: {error}"
                refusal = error if isinstance(error, AnimatError) else InvalidArgument(message)
                if self.names:
                    raise refusal from error
                unusable[name] = str(refusal)
        for name, robot in listed.items():
            observed = ", ".join(f"{quantity['name']} ({quantity['unit']})" for quantity in robot["observes"])
            numbers = {k: f"{v:g}" if isinstance(v, float) else v for k, v in robot["parameters"].items()}
            parameters = " ".join(f"{key}={value}" for key, value in numbers.items())
            if name.startswith("gymnasium:"):
                parameters += ", and what gymnasium.make takes for it"
            print(f"{name}: {robot['is']}\n  observes {observed}\n  parameters {parameters}")
            if (n := robot["commands"]) > 1:
                print(f"  takes {n} commands, each from a group of channels (--readouts), or --mapping none")
            for message in (*robot["lacks"].values(), *robot["caveats"]):
                print(f"  {message}")
        for name, why in unusable.items():
            print(f"{name} cannot be used: {why}")
        return {"robots": listed, "unusable": unusable}


def _describe(name: str) -> dict[str, Any]:
    from animat.robots import robot_to_dict
    from animat.robots.base import WITHOUT, lacking
    from animat.robots.gymnasium import GymnasiumRobot

    robot = robot_for(name)
    lacks, parameters = lacking(robot), robot_to_dict(robot)["parameters"]
    if isinstance(robot, GymnasiumRobot):
        # Its other parameters were found by inspecting the environment.
        parameters = {"episode_limit": robot.episode_limit, **dict(robot.settings)}
    return {
        "is": (type(robot).__doc__ or "").strip().partition("\n")[0],
        "observes": [{"name": quantity.name, "unit": quantity.unit} for quantity in robot.observation_spec],
        "parameters": parameters,
        "commands": robot.n_commands,
        "can": [name for name in WITHOUT if name not in lacks],
        "lacks": lacks,
        "caveats": list(robot.caveats()),
    }
