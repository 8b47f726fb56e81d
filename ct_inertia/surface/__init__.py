"""Closed surfaces: read, mended, contoured and written."""
