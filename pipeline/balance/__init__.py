"""Weights and vibration: influence coefficients, the unbalance that a vibration means, records that contradict it."""
