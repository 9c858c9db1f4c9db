"""Real cars, and fakes, as a backend: samples from a network become ticks, commands go out."""
