"""What is delivered to a culture, and where on its array: pulses, patterns, the selection of electrodes, protocols."""
