"""Measure the stapes by the grey values around it."""
