"""Measurements of speed, run from a checkout; not a part of the package."""
