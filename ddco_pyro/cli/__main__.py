"""``python -m ddco_pyro.cli``."""

from ddco_pyro.cli.app import main

main()
