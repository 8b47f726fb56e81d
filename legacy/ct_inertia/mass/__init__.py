"""Density, calibration and point masses: from moments to the mass matrix and its budget."""
