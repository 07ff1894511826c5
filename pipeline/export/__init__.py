"""Identified bearings in the formats of other programs."""
