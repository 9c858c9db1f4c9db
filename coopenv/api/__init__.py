"""The standard faces of a world: PettingZoo, Gymnasium, spaces, rewards."""
