"""Steps per second of coopenv and of other projects' environments: `python -m benchmarks.speed`."""
