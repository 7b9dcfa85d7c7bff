"""Studies: methods compared over training seeds and tasks. A package of the checkout (``python -m studies``)."""
