"""Films: a robot, the neurons and the command, in step."""
