"""What decides between alternatives: the motion that others show, one ligament, what is left to be found."""
