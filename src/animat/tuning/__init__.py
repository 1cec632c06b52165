"""Tuning: a search for settings, with successive halving over trainings that go on."""
