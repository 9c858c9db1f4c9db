"""Cost of a vehicle tick, stage by stage, and against another checkout: `python -m benchmarks.stages`."""
