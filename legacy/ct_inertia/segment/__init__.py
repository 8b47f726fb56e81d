"""Find the stapes and the plate in a coarse view, and cut them out."""
