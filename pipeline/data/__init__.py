"""Vibration and its excitation: simulated, or read from files."""
