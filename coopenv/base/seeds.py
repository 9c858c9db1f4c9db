"""Seeds of worlds, and the keys of random streams that follow from them.

World w of a batch with seed s < 2^32 has the 64-bit key (w << 32) | s of its random streams, so that no two seeds share
a world, and world 0 of a batch is the single world of its seed. Seeds from 2^31 to 2^32 - 1 are reserved for
evaluation: in their worlds everything that is drawn in cells (`coopenv.world.random.cell_uniform`) is where it never is
in training.
"""

import secrets
from hashlib import sha256

from coopenv.base.errors import CoopenvError

EVALUATION_SEEDS = range(2**31, 2**32)
"""Seeds whose maps no other seed has: for the evaluation of agents only, not for training."""


def checked_seed(seed: object, what: str = "seed") -> int:
    """Return a seed, or `what` it is, as an int. Raises CoopenvError: it is not a whole number, or negative."""
    if isinstance(seed, bool) or not hasattr(seed, "__index__"):
        raise CoopenvError(f"{what} must be a whole number, got {seed!r}")
    number = seed.__index__()
    if number < 0:
        raise CoopenvError(f"{what} must not be negative, got {number}")
    return int(number)


def evaluation_seed(k: int) -> int:
    """Return the k-th seed for evaluation, 0 <= k < 2^31.

    Raises:
        CoopenvError: there is none.
    """
    number = checked_seed(k)
    if number >= len(EVALUATION_SEEDS):
        raise CoopenvError(f"there are {len(EVALUATION_SEEDS)} evaluation seeds, no number {number}")
    return EVALUATION_SEEDS[number]


def training_seed() -> int:
    """Return a random seed, from 0 to 2^31 - 1."""
    return secrets.randbits(31)


def world_keys(seed: object, worlds: int = 1, first: int = 0) -> list[int]:
    """Return the keys of worlds first .. first + worlds - 1 of a seed; one beyond 2^32 is hashed to one for training.

    Raises:
        CoopenvError: it is no seed.
    """
    number = checked_seed(seed)
    if number >= 2**32:
        number = int.from_bytes(sha256(str(number).encode()).digest()[:4], "little") >> 1
    return [world << 32 | number for world in range(first, first + worlds)]
