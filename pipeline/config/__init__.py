"""The configuration: its schema, the units at its edge, and its composition from ``conf/``."""
