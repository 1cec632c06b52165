"""What stimulation does: responses, bursts set apart, and neuron simulators made of them."""
