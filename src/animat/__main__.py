"""`python -m animat` runs the command `animat`."""

import os
import sys

from animat.ctrl_c import interruptible


def main() -> int:
    """Run one command (`animat.cli.main`); Ctrl-C or a kill ends it with one line, even while it is being loaded."""
    # The user's own settings of matplotlib would change figures; if they want LaTeX, labels would have to be LaTeX. A
    # backend, which no figure of ours needs, may be one that this matplotlib does not have.
    os.environ["MATPLOTLIBRC"] = os.devnull
    os.environ.pop("MPLBACKEND", None)
    try:
        with interruptible():
            from animat.cli import main as run

            status = run()
    except KeyboardInterrupt:
        print("animat: interrupted", file=sys.stderr)
        status = 130
    if status == 130:
        # Without waiting for compiled programs, which crash if they still run while Python exits. All is printed:
        # the command has flushed its output, and standard error is written line by line.
        os._exit(status)
    return status


if __name__ == "__main__":
    sys.exit(main())
