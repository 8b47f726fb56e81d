"""Universal files (UFF, UNV): datasets, functions, geometry, spectra and time responses."""
