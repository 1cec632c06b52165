"""Bodies with a task: the contract (`base`), and one file per robot."""

from animat.robots.arm import ArmState, TwoLinkArm
from animat.robots.base import Quantity, Robot
from animat.robots.cartpole import Cartpole, CartpoleState
from animat.robots.detour import Detour
from animat.robots.gymnasium import GymnasiumRobot
from animat.robots.navigation import Navigation, NavigationState
from animat.robots.registry import ROBOTS, register_robot, robot_from_dict, robot_named, robot_to_dict
from animat.robots.shuttle import Shuttle, ShuttleState
from animat.robots.swing_up import SwingUp, SwingUpState
from animat.robots.wheels import Wheels, WheelsState

__all__ = [
    "ROBOTS", "ArmState", "Cartpole", "CartpoleState", "Detour", "GymnasiumRobot", "Navigation", "NavigationState",
    "Quantity", "Robot", "Shuttle", "ShuttleState", "SwingUp", "SwingUpState", "TwoLinkArm", "Wheels", "WheelsState",
    "register_robot", "robot_from_dict", "robot_named", "robot_to_dict",
]  # fmt: skip
