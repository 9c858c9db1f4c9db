"""Measurements: steps per second, and observers compared."""
