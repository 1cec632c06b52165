"""What is delivered to a culture and where on its array: pulses, patterns, electrode selections and protocols."""
