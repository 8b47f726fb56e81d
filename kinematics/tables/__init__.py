"""Tidy tables: the vibrometer's rows, points and frequencies, and everything that can be wrong with them."""
