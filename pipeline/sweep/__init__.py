"""Passing a critical speed: response to a linear sweep, fit of a run-up, and what a steady reading makes of it."""
