"""Commands of cars: `coopenv svea`, and those that read their bags."""

PANEL = "Cars"
"""Group of these commands in the list of all."""
