"""Fits from separate tests: modal parameters, springs and dampers, each with its standard deviation."""
