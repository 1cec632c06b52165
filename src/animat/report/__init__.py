"""Figures, one per file of the story, and the single-file HTML; they are drawn from results and compute none."""
