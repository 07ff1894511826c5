"""Bearing coefficients of rotating machines identified from their vibration (FEM-NN)."""

__version__ = "0.1.0"
