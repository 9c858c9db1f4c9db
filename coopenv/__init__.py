"""Cooperative localisation of connected vehicles as a standard multi-agent environment."""
