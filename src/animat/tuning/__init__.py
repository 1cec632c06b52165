"""Tuning: a search for settings, with successive halving of trainings that are continued from rung to rung."""
