"""Sources of ticks: the simulator, recordings, and programs that move the vehicles."""
