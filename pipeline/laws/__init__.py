"""Bearing laws: coefficients of few physical numbers, over speed and operating conditions."""
