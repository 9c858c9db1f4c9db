"""How messages travel: one protocol, several networks."""
