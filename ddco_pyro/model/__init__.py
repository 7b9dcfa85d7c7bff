"""The model: the AHMM as a Pyro program, a hierarchy's networks, encoders of observations and controls."""
