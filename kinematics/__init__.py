"""Rigid-body motion from laser vibrometer measurements."""
