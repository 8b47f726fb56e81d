"""Weighted least squares of rigid motion at every frequency line."""
