"""Commands of cars: `coopenv svea`, and those that read their bags."""
