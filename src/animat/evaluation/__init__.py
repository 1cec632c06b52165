"""How good policies are: episodes, controls beside them, statistics, and the optimal return."""
