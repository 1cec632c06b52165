"""Detects spikes in raw traces: `spikes` does so by the `settings`, in chunks and on all cores."""
