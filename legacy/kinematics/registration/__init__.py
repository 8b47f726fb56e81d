"""Where things are: fiducials, surfaces of the scan, frames, calibration of the geometry."""
