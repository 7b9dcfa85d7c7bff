"""From a spec and demonstrations to a fitted hierarchy, its run folder and its numbers."""
