"""How fast policies are trained and answer, compared with third-party learners: see README.md in this folder.

    python benchmarks/training.py [--quick] [--json results.json]

Every measurement runs in its own process, pinned to one core before anything is imported.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import peers
from training_table import print_table

MIB = 2**20


def main() -> int:
    """Run all parts, or in a child process one of them, and print the table."""
    parser = argparse.ArgumentParser(description="How fast policies are trained and answer, compared with others.")
    parser.add_argument("--quick", action="store_true", help="about two minutes: fewer repeats, peers cut off sooner")
    parser.add_argument("--json", metavar="FILE", help="write all measurements to a file")
    parser.add_argument("--return", type=float, default=40.0, dest="wanted", help="mean return to reach (default: 40)")
    parser.add_argument("--cap-s", type=float, help="seconds of training after which a peer is cut off")
    parser.add_argument("--part", choices=sorted(PARTS), help=argparse.SUPPRESS)
    parser.add_argument("--core", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--given", default="{}", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        if options.core is not None:
            os.sched_setaffinity(0, {options.core})
        print(json.dumps(PARTS[options.part](**json.loads(options.given))))
        return 0

    cap_s = options.cap_s or (20.0 if options.quick else 150.0)
    with tempfile.TemporaryDirectory() as folder:
        measured = measure(Path(folder), quick=options.quick, wanted=options.wanted, cap_s=cap_s)
    print_table(measured)
    if options.json:
        Path(options.json).write_text(json.dumps(measured, indent=2) + "\n")
    return 0


# --- one process per part -------------------------------------------------------------------------------------------


def start(part: str, cache: Path, core: int | None, **given: Any) -> subprocess.Popen[str]:
    """Run a part in its own process, with its own folder of compiled programs."""
    command = [sys.executable, __file__, "--part", part, "--given", json.dumps(given)]
    command += [] if core is None else ["--core", str(core)]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PLATFORMS": "cpu"}
    return subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True)


def finish(process: subprocess.Popen[str]) -> dict[str, Any]:
    """The measurements of a part."""
    output, _ = process.communicate()
    if process.returncode != 0:
        raise SystemExit(f"a part of the benchmark ended with status {process.returncode}: {process.args!r}")
    result: dict[str, Any] = json.loads(output.splitlines()[-1])
    return result


def measure(folder: Path, *, quick: bool, wanted: float, cap_s: float) -> dict[str, Any]:
    """Run all parts."""
    cores = sorted(os.sched_getaffinity(0))
    first = cores[0]
    cache = folder / "cache"

    def alone(part: str, **given: Any) -> dict[str, Any]:
        say(f"{part} {given or ''}")
        return finish(start(part, cache, first, **given))

    measured: dict[str, Any] = {"machine": machine(len(cores)), "wanted_return": wanted, "quick": quick}
    measured["compile_cold"] = alone("compilation", policies=5)
    measured["compile_cached"] = alone("compilation", policies=5)
    repeats = 3 if quick else 10
    measured["one_policy"] = alone("rate", policies=1, repeats=repeats)
    measured["five_policies"] = alone("rate", policies=5, repeats=repeats)
    measured["memory"] = alone("memory", folder=str(folder / "five"))
    measured["forward"] = alone("forward", calls=5_000 if quick else 50_000)

    say("time to the same return: ours")
    ladder = [100 * round(100 * 1.25**step) for step in range(20)]
    measured["ours"] = finish(start("ours", cache, None, folder=str(folder / "ten"), ladder=ladder, wanted=wanted))
    for peer in peers.PEERS:
        if importlib.util.find_spec(peer.split(",")[0]) is None:
            measured[peer] = None
            continue
        say(f"time to the same return: {peer}, for {cap_s:g} s of training at most")
        # Two at the same time, one on each core, as ours uses both too.
        running = [
            start("peer", cache, core, name=peer, seed=seed, wanted=wanted, cap_s=cap_s)
            for seed, core in enumerate(cores[:2])
        ]
        measured[peer] = of_ten([finish(process) for process in running], cap_s, measured["ours"]["wall_s"])
    return measured


def of_ten(seeds: list[dict[str, Any]], cap_s: float, ours_s: float) -> dict[str, Any]:
    """Scale from one policy per core to ten policies on as many cores; lower bounds if one was cut off."""
    scale = 10 / len(seeds)
    first_s = scale * statistics.mean(seed["first_s"] or cap_s for seed in seeds)
    held_s = scale * statistics.mean(seed["training_s"] for seed in seeds)
    return {
        "seeds": seeds,
        "first": {"ten_s": first_s, "ratio": first_s / ours_s, "all": all(seed["first_s"] for seed in seeds)},
        "held": {"ten_s": held_s, "ratio": held_s / ours_s, "all": all(seed["held"] for seed in seeds)},
    }


def machine(n_cores: int) -> dict[str, Any]:
    """A description of the machine."""
    names = ("animat", "jax", "numpy", "stable_baselines3", "sbx-rl", "torch")
    versions = {}
    for name in names:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return {"cores": n_cores, "load": os.getloadavg()[0], "python": platform.python_version(), "versions": versions}


def say(what: str) -> None:
    """Print the progress to standard error."""
    print(f"[{time.strftime('%H:%M:%S')}] {what}", file=sys.stderr, flush=True)


# --- the parts ------------------------------------------------------------------------------------------------------


def algorithm() -> Any:
    """Our default settings, but always with eight iterations per update."""
    from dataclasses import replace

    from animat.training.settings import SAC

    default = SAC()
    return replace(default, gradient_steps=max(1, default.environments // 8))


def program(policies: int) -> tuple[Any, Any, Any, Any, Any]:
    """(environment, settings, simulator, chunk to compile, learners to create), as a worker makes them."""
    from animat.coding.mapping import mapping_named
    from animat.compilation import keep_compilations
    from animat.environment import Animat
    from animat.neurons.synthetic import synthetic_simulator
    from animat.robots.cartpole import Cartpole
    from animat.training.group import programs

    keep_compilations()
    simulator, settings = synthetic_simulator(), algorithm()
    environment = Animat(Cartpole(), mapping_named("9-thresholds"), simulator.n_conditions)
    beginning, chunk = programs(environment, settings)
    return environment, settings, simulator, chunk, beginning


def compilation(policies: int) -> dict[str, Any]:
    """Seconds from Python functions to compiled ones; cached if they are in the folder of compiled programs."""
    import jax
    import jax.numpy as jnp

    _, _, simulator, chunk, beginning = program(policies)
    keys = jax.random.split(jax.random.key(0), policies)
    jax.block_until_ready((keys, jnp.int32(0) + 1, simulator))
    took: dict[str, Any] = {}
    began = time.perf_counter()
    learners = jax.block_until_ready(beginning(keys))
    took["begin_s"] = time.perf_counter() - began
    lowered = chunk.lower(learners, simulator, jnp.int32(0), jnp.int32(1))
    took["trace_s"] = time.perf_counter() - began - took["begin_s"]
    lowered.compile()
    took["all_s"] = time.perf_counter() - began
    took["compile_s"] = took["all_s"] - took["begin_s"] - took["trace_s"]
    return took


def rate(policies: int, repeats: int) -> dict[str, Any]:
    """Iterations per second with learning, all policies together: best and median of several chunks."""
    import jax
    import jax.numpy as jnp

    _, settings, simulator, chunk, beginning = program(policies)
    learners = beginning(jax.random.split(jax.random.key(0), policies))
    rounds, done, seconds = max(1, 40_000 // (settings.environments * policies)), 0, []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        learners, _ = jax.block_until_ready(chunk(learners, simulator, jnp.int32(done), jnp.int32(done + rounds)))
        seconds.append(time.perf_counter() - began)
        done += rounds
    seconds = seconds[1:]  # the first one compiles
    iterations = rounds * settings.environments * policies
    return {
        "environments": settings.environments,
        "gradient_steps": settings.gradient_steps,
        "batch": settings.batch,
        "hidden": settings.hidden,
        "best_per_s": iterations / min(seconds),
        "median_per_s": iterations / statistics.median(seconds),
        "update_us": 1e6 * min(seconds) / (rounds * settings.gradient_steps * policies),
    }


def timeline() -> Any:
    """The synthetic culture as a timeline of one recording."""
    import synthetic
    from animat.neurons.synthetic import synthetic_simulator

    return synthetic.timeline(synthetic_simulator())


def training(policies: int, iterations: int, seed: int = 1) -> Any:
    """What `animat train cartpole --mapping 9-thresholds` trains, at eight iterations per update."""
    from animat.coding.mapping import mapping_named
    from animat.robots.cartpole import Cartpole
    from animat.training.specification import Training

    return Training(
        robot=Cartpole(),
        mapping=mapping_named("9-thresholds"),
        policies=policies,
        iterations=iterations,
        seed=seed,
        shadowing=False,
        algorithm=algorithm(),
    )


def memory(folder: str) -> dict[str, Any]:
    """Peak resident memory of a worker that trains five policies, as the kernel reports it for ended children."""
    import resource

    from animat.execution.training import train

    # Ten are two groups of five.
    train(training(10, 50_000), timeline(), folder, workers=1)
    of_worker = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    # A child starts from its parent's figure, so its own is only known if it exceeds that.
    of_parent = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {"worker_mib": of_worker / MIB, "parent_mib": of_parent / MIB}


def forward(calls: int) -> dict[str, Any]:
    """Microseconds to answer one observation: our numpy policy, and the same network under jax.jit."""
    import jax
    import numpy as np

    from animat.coding.mapping import mapping_named
    from animat.responses.condition import Condition
    from animat.robots.cartpole import Cartpole
    from animat.training.networks import Layer
    from animat.training.networks import forward as jax_forward
    from animat.training.policy import Policy

    rng = np.random.default_rng(0)
    sizes = ((4, 64), (64, 64), (64, 5))
    policy = Policy(
        weights=tuple(rng.normal(0, 0.3, size).astype(np.float32) for size in sizes),
        biases=tuple(np.zeros(size[1], np.float32) for size in sizes),
        scales=np.ones(4, np.float32),
        robot=Cartpole(),
        mapping=mapping_named("9-thresholds"),
        conditions=tuple(Condition(str(i), float(i), "") for i in range(5)),
    )
    network = tuple(
        Layer(jax.numpy.asarray(w), jax.numpy.asarray(b)[None])
        for w, b in zip(policy.weights, policy.biases, strict=True)
    )
    compiled = jax.jit(lambda observation: jax_forward(network, observation[None])[0])
    observations = rng.normal(0, 0.1, (calls, 4)).astype(np.float32)
    answers: dict[str, Callable[[Any], Any]] = {
        "numpy": policy.outputs,
        "numpy, action drawn": lambda observation: policy.act(observation, rng),
        "jax.jit": lambda observation: np.asarray(compiled(observation)),
    }
    took = {}
    for name, answer in answers.items():
        seconds = []
        for observation in observations:
            began = time.perf_counter()
            answer(observation)
            seconds.append(time.perf_counter() - began)
        later = np.array(seconds[calls // 10 :]) * 1e6
        took[name] = {"median_us": float(np.median(later)), "p99_us": float(np.percentile(later, 99))}
    return took


def ours(folder: str, ladder: list[int], wanted: float) -> dict[str, Any]:
    """Wall-clock seconds of the shortest training run of ten policies, among several lengths, that reaches the return.

    This is all of `train`: starting processes, importing, loading compiled programs, training, checkpoints, saving. The
    next length must reach the return too.
    """
    from animat.coding.mapping import mapping_named
    from animat.environment import Animat
    from animat.evaluation.rollouts import networks_of, roll_out
    from animat.execution.training import train
    from animat.robots.cartpole import Cartpole

    culture = timeline()
    # A different seed, so that the first length is measured with compiled programs, like all the others.
    train(training(10, 10_000, seed=2), culture, f"{folder}-first")
    tried = []
    for iterations in ladder:
        began = time.perf_counter()
        policies = train(training(10, iterations), culture, f"{folder}-{iterations}")
        wall_s = time.perf_counter() - began
        simulator = culture.at(0.0)
        environment = Animat(Cartpole(), mapping_named("9-thresholds"), simulator.n_conditions)
        actors = networks_of(list(policies.values()), greedy=True)
        returns = roll_out(environment, simulator, actors, episodes=100, seed=7).returns.mean(axis=1)
        tried.append(
            {
                "iterations": iterations,
                "wall_s": wall_s,
                "mean_return": float(returns.mean()),
                "lowest_return": float(returns.min()),
            }
        )
        reached = [each["mean_return"] >= wanted for each in tried[-2:]]
        if reached == [True, True]:
            return {**tried[-2], "reached": True, "tried": tried}
    return {**tried[-1], "reached": False, "tried": tried}


PARTS: dict[str, Callable[..., dict[str, Any]]] = {
    "compilation": compilation,
    "rate": rate,
    "memory": memory,
    "forward": forward,
    "ours": ours,
    "peer": peers.train_peer,
}


if __name__ == "__main__":
    sys.exit(main())
