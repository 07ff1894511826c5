"""Identified against modelled coefficients, and metrics against thresholds."""
