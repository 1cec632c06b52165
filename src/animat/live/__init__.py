"""Parameter shadowing on one culture: record, train, refresh, then run in closed loop."""
