"""Soft Actor-Critic, several policies at once on pinned workers, and the policies that come of it."""
