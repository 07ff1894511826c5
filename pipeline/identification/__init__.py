"""Unknown coefficients as trainable functions of the rotor speed, and their training (paper, Algorithm 1)."""
