"""A world that follows an environment of highway-env which somebody else steps."""

from coopenv.backends.moved import MovedWorld, Poses
from coopenv.backends.simulated import Simulated


class FollowedWorld(MovedWorld):
    """One world whose vehicles stand where `present` says."""

    present: Poses

    def restart(self) -> None:
        """Begin an episode where the vehicles stand, see `World.restart`."""
        if self.mask.numpy().any():
            self.place(0, self.present)
        super().restart()

    def fetch(self) -> bool:
        """Move the vehicles to where they stand."""
        self.move(0, self.present)
        return True


class Followed(Simulated):
    """One world that follows an environment of highway-env."""

    kind = FollowedWorld
