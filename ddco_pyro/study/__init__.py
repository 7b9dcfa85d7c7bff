"""Studies: methods compared over training seeds and tasks, as a YAML file declares it (``ddco-pyro study``)."""
