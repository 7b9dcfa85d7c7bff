"""Segments of demonstrations: the most likely option of a run at each step, in memory and in files."""
