"""Shaft and discs as matrices, bearings as tables of coefficients over speed."""
