"""highway-env as a co-simulator."""
