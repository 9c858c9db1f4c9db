"""How planar observers do on robots unlike those that they were fitted to (docs/data.md)."""
