"""The model: the AHMM as a Pyro program, the networks of a hierarchy, and how observations and controls are encoded."""
