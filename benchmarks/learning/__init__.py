"""The study of learning: agents that train by environment, arm and seed, and their cards."""
