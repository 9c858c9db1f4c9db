"""A uniform grid of square cells that finds bodies near a place, exactly: users test what is in the cells of a window.

The grid has `across` cells along x and as many along y, and repeats: a window no larger than the grid meets each
of its cells once. Small worlds have one cell, and then all pairs are tested. Moving items (agents, then bodies of the
traffic) are lists that are linked anew at each tick; buildings, which do not move, are in every cell that they reach.
"""

from typing import Any

import warp as wp

from coopenv.world.warp_internals import device_function

FAR = wp.constant(1.0e8)
"""Largest number of a cell, so that it fits into an integer."""
WIDER, ROUNDING = wp.constant(1.01), wp.constant(0.01)
"""Factor of the reach of a window, and m that are added to it, so that rounding leaves nothing out."""


@wp.func
def cell_of(model: Any, x: Any) -> int:
    """Return the number of the cell of a coordinate, m; without the repetition."""
    far = type(x)(FAR)
    return int(wp.floor(wp.clamp(x * model.cells.per_metre, -far, far)))


@wp.func
def cell_at(model: Any, x: int, y: int) -> int:
    """Return the index of a cell in the grid, which repeats."""
    return (x & (model.cells.across - 1)) + model.cells.across * (y & (model.cells.across - 1))


@device_function
def window_about(model: Any, first: Any, second: Any, reach: Any):
    """Return the window of cells within `reach`, m, of the rectangle between two points.

    Returns:
        Numbers (x, y) of its first cell, and how many cells it has along each axis.
    """
    if model.cells.across == 1:
        return 0, 0, 1, 1
    more = reach * type(reach)(WIDER) + type(reach)(ROUNDING)
    x = cell_of(model, wp.min(first[0], second[0]) - more)
    y = cell_of(model, wp.min(first[1], second[1]) - more)
    columns = wp.min(cell_of(model, wp.max(first[0], second[0]) + more) - x + 1, model.cells.across)
    rows = wp.min(cell_of(model, wp.max(first[1], second[1]) + more) - y + 1, model.cells.across)
    return x, y, columns, rows


@wp.func
def last_of_all(model: Any) -> int:
    """Return the last item of a single cell; -1: there are several cells."""
    return wp.where(model.cells.across == 1, model.agents + model.traffic - 1, -1)


@wp.func
def first_in(state: Any, world: int, cell: int, last: int) -> int:
    """Return the first item of a cell; -1: none. `last` is that of all, read once per window."""
    if last >= 0:
        return 0
    return state.first_item[world, cell]


@wp.func
def next_in(state: Any, world: int, item: int, last: int) -> int:
    """Return the item that follows one in its cell; -1: none. `last` as for `first_in`."""
    if last >= 0:
        return wp.where(item < last, item + 1, -1)
    return state.next_item[world, item]


@device_function
def put_into_cell(model: Any, state: Any, world: int, item: int, position: Any):
    """Put an item into the grid, in front of those that are in its cell."""
    cell = cell_at(model, cell_of(model, position[0]), cell_of(model, position[1]))
    state.next_item[world, item] = state.first_item[world, cell]
    state.first_item[world, cell] = item


@device_function
def clear_cells(model: Any, state: Any, world: int):
    """Empty the grid of a world but for the traffic; a single cell always has all items."""
    reach = model.cells.body_reach
    for cell in range(model.cells.across * model.cells.across):
        state.first_item[world, cell] = -1
    for k in range(model.traffic):
        reach = wp.max(reach, wp.length(state.traffic_half[world, k]))
        put_into_cell(model, state, world, model.agents + k, state.traffic_position[world, k])
    state.body_reach[world] = reach


@device_function
def sort_into_cells(model: Any, state: Any, world: int):
    """Fill the grid of a world with where everything is now."""
    if model.cells.across > 1:
        clear_cells(model, state, world)
        for agent in range(model.agents):
            put_into_cell(model, state, world, agent, state.position[world, agent])


@device_function
def has_body(model: Any, state: Any, world: int, item: int) -> bool:
    """Return whether an item is there and is a box, not a point."""
    if item >= model.agents:
        edges = state.traffic_half[world, item - model.agents]
        return edges[0] > edges.dtype(0.0)
    half = model.scene.body_half[item]
    return half[0] > half.dtype(0.0) and state.present[world, item] != 0


@device_function
def body_of(model: Any, state: Any, world: int, item: int):
    """Return rotation, centre and half edges (m) of the box of an item of the grid that has one."""
    if item >= model.agents:
        k = item - model.agents
        return state.traffic_rotation[world, k], state.traffic_position[world, k], state.traffic_half[world, k]
    R = state.rotation[world, item]
    center = state.position[world, item] + R * model.scene.body_center[item]
    return R, center, model.scene.body_half[item]
