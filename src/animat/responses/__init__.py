"""What stimulation does: windows after the stimuli, conditions, bursts set apart, `Responses`, and their quality."""
