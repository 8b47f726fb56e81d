"""What does not fit a rigid motion: which channel, what kind of fault, how sure."""
