"""Studies: a specification, its jobs, the folder that they fill, and going on where one stopped."""
