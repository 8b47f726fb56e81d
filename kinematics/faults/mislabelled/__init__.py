"""Faults that one body by itself does not show: wrong labels, lines and runs, and the phase convention."""
