"""Methods compared over training seeds and tasks: a package of the checkout (``python -m studies``)."""
