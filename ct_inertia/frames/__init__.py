"""Frames of the footplate and of the plate, with their covariances, and what a person says about them."""
