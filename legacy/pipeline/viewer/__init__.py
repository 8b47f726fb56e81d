"""The stapes in three dimensions, as a block of a page: surfaces, frames, beams, modes, measured motion."""
