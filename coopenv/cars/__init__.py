"""Network cars: messages, transports, command gate, fake cars, recordings, backend. SVEA is the first make."""
