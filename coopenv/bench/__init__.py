"""Benchmarks: drivers on held-out worlds, observers on the same records, trainings, many seeds."""
