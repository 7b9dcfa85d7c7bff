"""The numbers of a trained model: ``metrics.json``."""
