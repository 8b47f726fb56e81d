"""MATLAB and HDF5 files as plain values, opened in a guard process first."""
