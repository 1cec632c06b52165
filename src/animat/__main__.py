"""`python -m animat` runs the command `animat`."""

import sys

from animat.ctrl_c import interruptible


def main() -> int:
    """Run one command (`animat.cli.main`); Ctrl-C or a kill ends it with one line, even while it is being loaded."""
    try:
        with interruptible():
            from animat.cli import main as run

            return run()
    except KeyboardInterrupt:
        print("animat: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
