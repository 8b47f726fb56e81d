"""Where things are: registration, surfaces of the scan, frames, calibration of the geometry."""
