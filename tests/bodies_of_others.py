"""Environments of Gymnasium for tests: registered by importing this, `gymnasium:bodies_of_others:Slider-v0`."""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, Space

SEEN = Box(-2.0, 2.0, (2,), np.float32)


class Slider(gymnasium.Env[Any, Any]):
    """Slides by its action, from -1 left to 3 right of it; the best is to stay in the middle. It ends beyond 2."""

    def __init__(self, fault: str = "", gain: float = 0.1, after: float = 30) -> None:
        self.action_space: Space[Any] = Box(-1.0, 3.0, (1,), np.float32)
        self.observation_space: Space[Any] = SEEN
        self.fault, self.gain, self.after = fault, gain, after
        self.made, self.steps = 0.0, 0
        if fault == "levels":
            self.action_space = Discrete(3, start=-1)
        elif fault == "pair":
            self.action_space = Box(-1.0, 1.0, (2,), np.float32)
        elif fault in ("dict", "multi-binary"):
            self.action_space = Dict(a=SEEN) if fault == "dict" else MultiBinary(3)
        elif fault == "unbounded":
            self.action_space = Box(-np.inf, np.inf, (1,), np.float32)
        elif fault in ("many levels", "no dimension", "many dimensions"):
            size = {"no dimension": 0, "many dimensions": 65}.get(fault)
            self.action_space = Discrete(2000) if size is None else Box(-1.0, 1.0, (size,), np.float32)
        elif fault == "dict seen":
            self.observation_space = Dict(a=SEEN)
        elif fault == "unknown scale":
            self.observation_space = Box(-np.inf, np.inf, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.at = float(self.np_random.uniform(-0.5, 0.5))
        # Of a body whose episodes depend on what was before them.
        self.at += self.made * (self.fault == "remembers")
        self.made += 0.01
        return {"at": self.at} if self.fault == "starts" else self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        u = float(action) if self.fault == "levels" else float(action[0])
        if self.steps > self.after:
            self._break()
        self.at += self.gain * (u + 0.01 * self.np_random.standard_normal())
        ended = abs(self.at) > 2
        return self._seen(), (np.nan if self.fault == "nan reward" else -abs(self.at)), ended, False, {"u": u}

    def _seen(self) -> Any:
        if self.fault == "unknown scale":
            return np.array([self.at, 500.0], np.float32)
        if self.fault == "nan" and self.steps > self.after:
            return np.array([np.nan, 0.0], np.float32)
        if self.fault == "short" and self.steps > self.after:
            return np.zeros(1, np.float32)
        return np.array([self.at, self.gain], np.float32)

    def _break(self) -> None:
        if self.fault == "raises":
            raise ZeroDivisionError("a wheel came off")
        while self.fault == "hangs":
            time.sleep(0.01)


for name, fault in (
    ("Slider", ""),
    ("Levels", "levels"),
    ("Dict", "dict"),
    ("MultiBinary", "multi-binary"),
    ("Unbounded", "unbounded"),
    ("ManyLevels", "many levels"),
    ("NoDimension", "no dimension"),
    ("ManyDimensions", "many dimensions"),
    ("DictSeen", "dict seen"),
    ("UnknownScale", "unknown scale"),
    ("Remembers", "remembers"),
    ("Nan", "nan"),
    ("NanReward", "nan reward"),
    ("Short", "short"),
    ("Raises", "raises"),
    ("Hangs", "hangs"),
):
    gymnasium.register(f"{name}-v0", Slider, max_episode_steps=20, kwargs={"fault": fault})
gymnasium.register("Starts-v0", Slider, max_episode_steps=20, kwargs={"fault": "starts"})
gymnasium.register(
    "Wrapped-v0",
    Slider,
    max_episode_steps=20,
    additional_wrappers=(
        gymnasium.wrappers.RescaleAction.wrapper_spec(min_action=np.float32(-0.5), max_action=np.float32(0.5)),
    ),
)
gymnasium.register("Endless-v0", Slider)
gymnasium.register("Pair-v0", Slider, max_episode_steps=20, kwargs={"fault": "pair"})
