"""Everything long is made of tasks: their receipts, what runs them, and training as the plainest case."""
