"""animat."""

from animat.gym import register_environments

# Gymnasium has known plugins only by their import since 1.0. Nothing of an environment is loaded by this.
register_environments()
