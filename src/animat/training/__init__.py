"""Soft Actor-Critic, for several policies at once on pinned workers, and the resulting policies."""
