"""The closed loop: policy, stimulus, culture, response, mapping, robot, in time and logged."""
