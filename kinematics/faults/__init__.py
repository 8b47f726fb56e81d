"""Search for faults of channels, points, lasers and bodies, and their verdicts."""
