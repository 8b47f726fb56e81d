"""Frequency responses from time series, and stepped sines by lock-in."""
