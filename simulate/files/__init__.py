"""The files of a simulated study: formats of scans and of measurements."""
