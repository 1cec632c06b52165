"""Cultures: the contract, and one file per kind; drivers of hardware are in `devices`."""
