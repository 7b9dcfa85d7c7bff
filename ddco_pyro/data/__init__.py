"""Demonstrations: files, HDF5, sources, importing, inspection, the starting spec."""
