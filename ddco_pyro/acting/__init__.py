"""A fitted hierarchy that acts, and one that watches somebody else act."""
