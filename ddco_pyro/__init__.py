"""Discovery of deep continuous options (DDCO) as a Pyro model."""
