"""Call the Warp functions of routes on routes given as points."""

from __future__ import annotations

import string
from typing import Any

import numpy as np
import warp as wp

from coopenv.world.launch import start_warp
from coopenv.world.model import precision
from coopenv.world.route import place_on_route, point_on_route
from coopenv.world.state import allocate, state_struct
from tests.helpers.warp_calls import DTYPES

start_warp()


@wp.kernel(enable_backward=False)
def places_kernel(state: Any, query: wp.array(dtype=Any), found: wp.array(dtype=Any)):
    """Find the place of every query (x, y, -)."""
    i = wp.tid()
    q = query[i]
    s, lateral, heading = place_on_route(state, 0, 0, q[0], q[1])
    found[i] = type(q)(s, lateral, heading)


@wp.kernel(enable_backward=False)
def points_kernel(state: Any, query: wp.array(dtype=Any), found: wp.array(dtype=Any)):
    """Find the point at every query (s, -, -)."""
    i = wp.tid()
    q = query[i]
    x, y, heading = point_on_route(state, 0, 0, q[0])
    found[i] = type(q)(x, y, heading)


for dtype in DTYPES:  # one module for both precisions
    state_type, vectors = state_struct(precision(dtype)), wp.array(dtype=precision(dtype).vec3)
    for kernel in (places_kernel, points_kernel):
        wp.overload(kernel, [state_type, vectors, vectors])


def _found(function: Any, dtype: str, line: np.ndarray, query: np.ndarray) -> np.ndarray:
    p = precision(dtype)
    sizes = {**dict.fromkeys(string.ascii_uppercase, 1), "P": max(len(line), 1)}
    state = allocate(state_struct(p), sizes, "cpu")
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    if len(line):
        state.route.numpy()[0, 0] = np.column_stack([line, np.concatenate([[0.0], np.cumsum(steps)])])
        state.route_count.numpy()[0, 0] = len(line)
    given = wp.array(np.ascontiguousarray(query, dtype=p.numpy), dtype=p.vec3, device="cpu")
    found = wp.zeros_like(given)
    wp.launch(function, dim=len(query), inputs=[state, given, found], device="cpu")
    return np.asarray(found.numpy(), dtype=float)


def places(dtype: str, line: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Return (s, lateral, heading), (K, 3), of the points xy (K, 2) by the route with points `line` (P, 2)."""
    return _found(places_kernel, dtype, line, np.column_stack([xy, np.zeros(len(xy))]))


def points(dtype: str, line: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return (x, y, heading), (K, 3), at arc lengths s (K,)."""
    return _found(points_kernel, dtype, line, np.column_stack([s, s, s]))
