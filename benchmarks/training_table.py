"""The measurements of `training.py` as a table for a terminal."""

from __future__ import annotations

import statistics
from typing import Any

import peers
from animat.terminal_table import align_columns


def print_table(measured: dict[str, Any]) -> None:
    """Print the measurements."""
    one, five, memory_, forward_ = (measured[name] for name in ("one_policy", "five_policies", "memory", "forward"))
    cold, cached, ours_ = (measured[name] for name in ("compile_cold", "compile_cached", "ours"))
    wanted = measured["wanted_return"]
    reached = f"mean {ours_['mean_return']:.0f}, lowest {ours_['lowest_return']:.0f}"
    of_tracing = f"{cached['trace_s']:.2f} s of it is tracing"
    settings = f"{one['environments']} environments, {one['gradient_steps']} gradient steps, batch {one['batch']}"
    rows = [
        ("training, one core, replay ratio 1/8", "", settings),
        ("  one policy", f"{one['best_per_s']:,.0f} iterations/s", f"{one['update_us']:.0f} us per update"),
        (
            "  five policies side by side",
            f"{five['best_per_s']:,.0f} iterations/s",
            f"{five['update_us']:.0f} us per update; {five['best_per_s'] / 5:,.0f} each",
        ),
        ("  compiling, five policies, cold", f"{cold['all_s']:.2f} s", ""),
        (
            "  compiling, five policies, cached",
            f"{cached['all_s']:.2f} s",
            of_tracing,
        ),
        ("  peak memory of a worker, five policies", f"{memory_['worker_mib']:,.0f} MiB", ""),
        ("one answer of a policy, 64x64", "", "median, 99th percentile"),
    ]
    for name, took in forward_.items():
        slower = took["median_us"] / forward_["numpy"]["median_us"]
        note = "" if name == "numpy" else f"{slower:.1f} times numpy"
        rows.append((f"  {name}", f"{took['median_us']:.1f}, {took['p99_us']:.1f} us", note))
    rows += [
        (f"ten policies to a mean return of {wanted:g}", "", "Animat/Cartpole-v0, 9 thresholds"),
        (
            "  animat",
            f"{ours_['wall_s']:.1f} s" if ours_["reached"] else f"not in {ours_['wall_s']:.1f} s",
            f"{ours_['iterations']:,} iterations each; {reached}",
        ),
    ]
    for peer, name in peers.PEERS.items():
        found = measured[peer]
        if found is None:
            rows.append((f"  {name}", "not installed", ""))
            continue
        steps = statistics.mean(seed["steps"] for seed in found["seeds"])
        best = max(seed["best_return"] for seed in found["seeds"])
        for which, label in (("first", "first reached"), ("held", f"held for {peers.HELD} evaluations")):
            took = found[which]
            least = "" if took["all"] else "at least "
            rows.append(
                (f"  {name}, {label}", f"{least}{took['ten_s']:,.0f} s", f"{least}{took['ratio']:.1f} times ours")
            )
        rows[-1] = (*rows[-1][:2], f"{rows[-1][2]}; {steps:,.0f} steps each, best return {best:.0f}")
    print(f"{measured['machine']}")
    print("\n".join(align_columns(("", "", ""), rows)[1:]))
