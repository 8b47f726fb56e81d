"""Vibrometer measurements and the rigid-body coordinates of what they show."""
