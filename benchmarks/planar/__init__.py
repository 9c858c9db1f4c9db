"""Planar observers on robots other than the ones that they were fitted to (docs/data.md)."""
