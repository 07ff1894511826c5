"""Response of a mode to an unbalance while the speed changes at a constant rate.

The shaft turns by theta(t), Omega = d theta / dt, alpha = d Omega / dt. A mode of natural frequency w and damping ratio
z, with the unbalance u (mass times eccentricity over the modal mass), follows

    q'' + 2 z w q' + w^2 q = u (Omega^2 - j alpha) e^{j theta} = -u d^2/dt^2 e^{j theta}

An order tracker gives Q = q e^{-j theta}, the vector on the turning shaft. With the pole s = -z w + j w sqrt(1 - z^2)
and its conjugate, and h(t) = (e^{st} - e^{s* t}) / (s - s*),

    Q = -u [ (s^2 J(s) - s*^2 J(s*)) / (s - s*) + 1 ],   J(s) = integral_0^inf e^{(s - j Omega) v + j alpha v^2 / 2} dv

for a sweep that began long before. J is a complex error function, J = sqrt(pi) / (2 r) w(j (j Omega - s) / (2 r)) with
r = sqrt(-j alpha / 2) and Faddeeva's w: F. M. Lewis, "Vibration during acceleration through a critical speed", Trans.
ASME 54 (1932) 253-261, in the form of I. Fernlund, Trans. Chalmers Univ. 273 (1963). Without a sweep J = 1 / (j Omega -
s), and Q is the steady response u Omega^2 / (w^2 - Omega^2 + 2 j z w Omega).

Legend: S speeds. SI, rad/s.
"""

from __future__ import annotations

import numpy as np


def respond_to_ramp(frequency: float, damping: float, speeds: np.ndarray, rate: float) -> np.ndarray:
    """Q (S,) complex of the unit unbalance u = 1 at ``speeds`` (S,) rad/s of a sweep at ``rate`` rad/s^2.

    ``frequency`` w is in rad/s, ``damping`` z between 0 and 1. A negative ``rate`` is a run-down.
    """
    pole = frequency * complex(-damping, np.sqrt(1 - damping**2))
    other = pole.conjugate()
    parts = pole**2 * _integrate(pole, speeds, rate) - other**2 * _integrate(other, speeds, rate)
    return np.asarray(-parts / (pole - other) - 1)


def respond_steadily(frequency: float, damping: float, speeds: np.ndarray) -> np.ndarray:
    """Q (S,) complex of the same at constant speeds."""
    return np.asarray(speeds**2 / (frequency**2 - speeds**2 + 2j * damping * frequency * speeds))


def decay_freely(frequency: float, damping: float, speeds: np.ndarray, rate: float) -> np.ndarray:
    """e^{s t - j theta} (S,) complex: a mode that dies away as a tracker sees it, 1 at the first of ``speeds`` (S,).

    Speeds are in rad/s; ``rate`` is in rad/s^2, and not zero.
    """
    pole = frequency * complex(-damping, np.sqrt(1 - damping**2))
    time = (speeds - speeds[0]) / rate
    angle = (speeds**2 - speeds[0] ** 2) / (2 * rate)
    return np.asarray(np.exp(pole * time - 1j * angle))


def _integrate(pole: complex, speeds: np.ndarray, rate: float) -> np.ndarray:
    """J (S,) of the ``pole``."""
    from scipy.special import wofz

    apart = 1j * speeds - pole
    if rate == 0:
        return np.asarray(1 / apart)
    # The principal root has a positive real part for both signs of the rate: the integral converges.
    root = np.sqrt(-0.5j * rate)
    return np.asarray(np.sqrt(np.pi) / (2 * root) * wofz(1j * apart / (2 * root)))
