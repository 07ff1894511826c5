"""Ratios of speed, each against a peer that is measured in turns with it. No time fails anything.

``python -m benchmarks [NAME ...] [--write docs/measured/benchmarks.md]``
"""
