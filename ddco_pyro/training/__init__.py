"""From a spec and demonstrations to trained networks."""
