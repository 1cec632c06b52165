"""Raw traces to spikes: `settings` says how, `spikes` does it, in chunks and on all cores.

`artefacts` removes what a stimulus leaves in the traces, `band` filters, `negative_peaks` finds spikes and says how
large a channel's noise is.
"""
