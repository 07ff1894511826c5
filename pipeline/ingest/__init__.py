"""Measured vibration as people have it (tables, universal files, time signals), made into what training reads."""
