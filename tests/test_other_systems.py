"""On a system without what only Linux has, such as macOS, the commands work and give the same results."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from animat.training.policy import load_policies

# Executed by Python before anything else. It cannot show how libraries behave on macOS.
WITHOUT_LINUX = """
import builtins, ctypes, io, os, resource

for name in dir(os):
    if name.startswith(("sched_set", "sched_get", "SCHED_")):
        delattr(os, name)
limit, symbol, opened = resource.setrlimit, ctypes.CDLL.__getattr__, io.open

def setrlimit(kind, limits):
    if kind == resource.RLIMIT_AS:
        raise ValueError("current limit exceeds maximum limit")
    limit(kind, limits)

def getattribute(library, name):
    if name == "prctl":
        raise AttributeError("symbol not found")
    return symbol(library, name)

def without_proc(file, *args, **kwargs):
    if str(file).startswith("/proc"):
        raise FileNotFoundError(2, "No such file or directory", str(file))
    return opened(file, *args, **kwargs)

resource.setrlimit, ctypes.CDLL.__getattr__ = setrlimit, getattribute
io.open = builtins.open = without_proc
"""


@pytest.mark.oracle
def test_without_what_only_linux_has_policies_are_the_same_and_run(tmp_path: Path) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site/sitecustomize.py").write_text(WITHOUT_LINUX)
    (tmp_path / "protocol.json").write_text('{"trials": 30}')

    def run(path: str, *arguments: str) -> None:
        environment = os.environ | {"PYTHONPATH": path}
        command = [sys.executable, "-m", "animat", *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr

    site = str(tmp_path / "site")
    probe = "import os; from animat.process import own_cores; print(hasattr(os, 'sched_getaffinity'), own_cores()[0])"
    seen = subprocess.run([sys.executable, "-c", probe], env=os.environ | {"PYTHONPATH": site}, capture_output=True)
    assert seen.stdout.split() == [b"False", b"0"]
    run(site, "record", "--protocol", "protocol.json", "--out", "recordings")
    train = ("train", "cartpole", "--recordings", "recordings", "--policies", "1", "--iterations", "2000", "--out")
    run(site, *train, "elsewhere")
    run("", *train, "here")
    elsewhere, here = (load_policies(tmp_path / out)["p0"].weights for out in ("elsewhere", "here"))
    assert all(map(np.array_equal, elsewhere, here))
    run(site, "run", "elsewhere", "--recordings", "recordings", "--episodes", "1", "--controls", "random")
    assert (tmp_path / "session/ticks.csv").exists()
