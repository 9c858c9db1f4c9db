"""What a vehicle tick costs, stage by stage, and against another checkout: `python -m benchmarks.stages`."""
