"""Parameter shadowing on a culture while it lives: record, train, refresh, then run in closed loop."""
