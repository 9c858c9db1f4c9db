"""A study of methods of learning, on equal budgets; `python -m benchmarks.methods`."""
