"""Rigid alignment of paired points: closed form, covariance, and faults of the pairs."""
