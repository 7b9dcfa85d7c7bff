"""A fitted model, its run folder, and what is done with it."""
