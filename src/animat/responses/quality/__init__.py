"""Findings that make responses doubtful, separate from their extraction."""
