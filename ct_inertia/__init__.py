"""Mass matrix of the stapes, in anatomical frames, from a micro-CT scan."""
