"""`python -m animat` is the command `animat`."""

import sys

from animat.cli import main

if __name__ == "__main__":
    sys.exit(main())
