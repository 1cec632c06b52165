"""Tasks, of which all long work consists: their receipts, their executors, and training as the simplest case."""
