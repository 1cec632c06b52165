"""Bodies with a task: the contract (`base`), and one file a robot."""

from animat.robots.base import Quantity, Robot
from animat.robots.cartpole import Cartpole, CartpoleState
from animat.robots.navigation import Navigation, NavigationState
from animat.robots.registry import ROBOTS, register_robot, robot_from_dict, robot_named, robot_to_dict

__all__ = [
    "ROBOTS",
    "Cartpole",
    "CartpoleState",
    "Navigation",
    "NavigationState",
    "Quantity",
    "Robot",
    "register_robot",
    "robot_from_dict",
    "robot_named",
    "robot_to_dict",
]
