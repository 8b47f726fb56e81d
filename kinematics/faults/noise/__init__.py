"""How much noise each channel has, and which channels have more than they should."""
