"""Networks of cars: transports, clocks and keys."""
