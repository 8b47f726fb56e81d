"""MATLAB files with spectra: layouts, mappings and variables."""
