"""Studies: a specification, its jobs, the folder that they fill, and resuming one that was stopped."""
