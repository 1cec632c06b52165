"""What is wanted of a robot, as data: regions of its quantities, and the reward and the ends that follow from them."""
