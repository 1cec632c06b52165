"""animat."""
