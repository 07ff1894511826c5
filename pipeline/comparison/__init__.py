"""The conventional methods beside the network: measurement, known rotor and unknowns in; coefficients out."""
