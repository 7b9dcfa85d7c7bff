"""Fitted hierarchies at run time: controllers and monitors."""
