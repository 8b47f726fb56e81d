"""Repeats and levels of one excitation: compared, tested, pooled."""
