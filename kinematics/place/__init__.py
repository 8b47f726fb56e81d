"""Where the vibrometer's coordinates are in the footplate frame, and what of that can be checked."""
