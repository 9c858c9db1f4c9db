"""Philox4x32-7 in NumPy (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

MULTIPLIER_0 = 0xD2511F53
MULTIPLIER_1 = 0xCD9E8D57
WEYL_0 = 0x9E3779B9  # golden ratio
WEYL_1 = 0xBB67AE85  # sqrt(3) - 1
MASK = 0xFFFFFFFF

Words4 = tuple[int, int, int, int]

ROUNDS = 7
KNOWN_ANSWERS: tuple[tuple[Words4, tuple[int, int], Words4], ...] = (
    ((0, 0, 0, 0), (0, 0), (0x5F6FB709, 0x0D893F64, 0x4F121F81, 0x4F730A48)),
    ((MASK, MASK, MASK, MASK), (MASK, MASK), (0x5207DDC2, 0x45165E59, 0x4D8EE751, 0x8C52F662)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0x4DFCCABA, 0x190A87F0, 0xC47362BA, 0xB6B5242A),
    ),
)
"""Random123's known-answer vectors of philox4x32-7: (counter, key, output)."""


def philox4x32(counter: Words4, key: tuple[int, int]) -> Words4:
    """Return the four output words of one counter under one key."""
    c0, c1, c2, c3 = philox4x32_array(counter, key).tolist()
    return c0, c1, c2, c3


def philox4x32_array(counter: ArrayLike, key: ArrayLike) -> NDArray[np.uint32]:
    """Return the output words (..., 4) of counters (..., 4) under keys (..., 2), over the leading axes."""
    counter_, key_ = np.asarray(counter, dtype=np.uint64), np.asarray(key, dtype=np.uint64)
    shape = np.broadcast_shapes(counter_.shape[:-1], key_.shape[:-1])
    counter_, key_ = np.broadcast_to(counter_, (*shape, 4)), np.broadcast_to(key_, (*shape, 2))
    mask, high = np.uint64(MASK), np.uint64(32)
    c0, c1, c2, c3 = (counter_[..., i] & mask for i in range(4))
    k0, k1 = key_[..., 0] & mask, key_[..., 1] & mask
    for _ in range(ROUNDS):
        product_0, product_1 = np.uint64(MULTIPLIER_0) * c0, np.uint64(MULTIPLIER_1) * c2
        c0, c1, c2, c3 = (
            (product_1 >> high) ^ c1 ^ k0,
            product_1 & mask,
            (product_0 >> high) ^ c3 ^ k1,
            product_0 & mask,
        )
        k0, k1 = (k0 + np.uint64(WEYL_0)) & mask, (k1 + np.uint64(WEYL_1)) & mask
    return np.stack([c0, c1, c2, c3], axis=-1).astype(np.uint32)
