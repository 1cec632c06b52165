"""Cultures on devices: the CL1 through cl-sdk, the MaxOne through maxlab."""
