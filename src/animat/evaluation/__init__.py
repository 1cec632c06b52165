"""How good policies are: episodes, controls, statistics, and the optimal return."""
