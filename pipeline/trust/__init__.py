"""Whether an answer can be trusted: what speaks for each coefficient, what against, and what to do next."""
