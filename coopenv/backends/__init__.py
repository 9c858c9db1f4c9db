"""Sources of ticks other than the simulator: recorded robots."""
