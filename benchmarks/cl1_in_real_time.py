"""How many neurons of the simulated culture a CL application can run in real time.

    python benchmarks/cl1_in_real_time.py [--neurons 200 300 400 600 1200] [--seconds 30]

The application reads 1,000 ticks per second and stimulates the channel of every spike, the highest possible load. Each
size runs in its own process, until its time is over or the SDK ends it. Needs Python 3.12, the extra `[cl1]`, and an
otherwise idle machine.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time


def application(neurons: int, seconds: float) -> dict[str, float | str]:
    """Run the application; return how often it stimulated and how long it took."""
    os.environ.pop("CL_SDK_ACCELERATED_TIME", None)
    from animat.cultures.devices.cl1_source import use_simulated_culture

    use_simulated_culture(seed=1, neurons=neurons)
    import cl

    stimuli = ticks = 0
    ended = ""
    used_s, began = sum(os.times()[:4]), time.perf_counter()
    try:
        with cl.open() as culture:
            pulse = cl.StimDesign(160, -1.0, 160, 1.0)
            for tick in culture.loop(ticks_per_second=1000, stop_after_seconds=seconds):
                ticks += 1
                for spike in tick.analysis.spikes:
                    culture.stim(spike.channel, pulse)
                    stimuli += 1
    except Exception as error:
        ended = str(error).splitlines()[0]
    took_s = time.perf_counter() - began
    return {
        "neurons": neurons,
        "ticks": ticks,
        "stimuli_a_s": stimuli / max(ticks / 1000, 1e-9),
        "wall_s": took_s,
        "processor_s": sum(os.times()[:4]) - used_s,
        "ended": ended,
    }


def main() -> int:
    """Run each size in its own process, and print a line for each."""
    parser = argparse.ArgumentParser(description="How many neurons a CL application can run in real time.")
    parser.add_argument("--neurons", type=int, nargs="+", default=[200, 300, 400, 600, 1200])
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.alone:
        print(json.dumps(application(options.neurons[0], options.seconds)))
        return 0
    for neurons in options.neurons:
        command = [sys.executable, __file__, "--alone", "--neurons", str(neurons), "--seconds", str(options.seconds)]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        said = json.loads(ran.stdout.splitlines()[-1]) if ran.stdout.strip() else {"ended": ran.stderr[-300:]}
        print(json.dumps(said), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
