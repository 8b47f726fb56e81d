"""Frequency responses and amplitudes estimated from time series."""
