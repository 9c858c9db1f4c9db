"""The standard interfaces of a world: PettingZoo, Gymnasium, spaces, rewards."""
