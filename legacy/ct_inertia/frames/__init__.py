"""The footplate frame and the plate frame, with their covariance."""
