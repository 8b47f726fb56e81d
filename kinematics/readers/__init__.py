"""Vibrometer files of every known format, read as tables of recordings and assembled to a measurement."""
