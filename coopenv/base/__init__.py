"""What every other package stands on: errors, results written whole, signals, seeds, user code, text for people."""
