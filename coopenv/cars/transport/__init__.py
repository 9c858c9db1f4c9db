"""Transports: one protocol, several networks."""
