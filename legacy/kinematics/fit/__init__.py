"""Weighted least squares of rigid motion: beams, noise, covariance, ratios, errors that lines share."""
