"""Repeats and levels of one excitation: compared, then pooled."""
