"""Fitted hierarchies at run time: controllers, monitors and saliency maps."""
