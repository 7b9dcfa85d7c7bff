"""Commands of the command line about a user's own files; :mod:`ddco_pyro.cli` gathers them."""
