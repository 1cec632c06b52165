"""Neuron simulators: what a culture answers, drawn from its responses, and their timeline over recordings."""
