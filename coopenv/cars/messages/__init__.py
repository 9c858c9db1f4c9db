"""Messages of cars: bytes, checked values, and bearings in frames."""
