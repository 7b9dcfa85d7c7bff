"""Tasks in simulation: the protocol, episodes, collecting demonstrations, films, Gymnasium."""
