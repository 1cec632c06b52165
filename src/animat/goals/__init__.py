"""Goals of a robot as data: regions of its quantities, and the rewards and ends of episodes that follow from them."""
