"""Sections of a page on the mass of a stapes, drawn from mass.json, the meshes and slices of the scan."""
