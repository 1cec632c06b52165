"""Detects spikes in raw traces: `spikes` does so by the `settings`, in chunks and on all cores.

`artefacts` removes stimulation artefacts from the traces, `band` filters them, and `negative_peaks` finds spikes and
estimates each channel's noise.
"""
