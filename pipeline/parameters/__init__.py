"""Uncertain numbers of the machine's model, and a machine that was built with other ones."""
