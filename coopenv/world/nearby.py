"""Neighbourhood of a vehicle: bodies, found by a grid of cells, and the agents that it keeps.

A uniform grid of square cells finds bodies near a position, exactly: users test the items in a window's cells. The grid
has `across` cells along x and as many along y, and repeats: a window no larger than the grid meets each of its cells
once. Small worlds have one cell, and then all pairs are tested. Moving items (agents, then bodies of the traffic) are
lists that are linked anew at each tick; buildings, which do not move, are in every cell that they reach.

A vehicle keeps the agents in range, which it may measure or receive, and earlier ones where there is room. Arrays of
its measurements have an entry per agent, arrays of its messages a box per sender. With the model's `kept` above 0,
there are only so many entries, regardless of the number of agents. An entry then stays with its agent
until another agent needs it; the agent that is farthest out of range makes room. In range are the agents that the
camera, or the radio, may reach. Vehicles whose neighbours are listed keep these. All senders without a box share the
last one, which is always empty.
"""

from typing import Any

import warp as wp

from coopenv.estimation import Sight
from coopenv.estimation.linalg import identity3
from coopenv.world.random import CAMERA_RANGE
from coopenv.world.warp_internals import device_function, outlined

FAR = wp.constant(1.0e8)
"""Largest cell number that fits into an integer."""
WIDER, ROUNDING = wp.constant(1.01), wp.constant(0.01)
"""Factor of a window's reach, and margin (m), so that rounding leaves nothing out."""


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
def first_in(model: Any, state: Any, world: int, cell: int) -> int:
    """Return the first item of a cell; -1: none."""
    if model.cells.across == 1:
        return 0
    return state.first_item[world, cell]


@wp.func
def next_in(model: Any, state: Any, world: int, item: int, last: int) -> int:
    """Return the item that follows one in its cell; -1: none. `last` is the grid's, read once per window."""
    if model.cells.across == 1:
        return wp.where(item < last, item + 1, -1)
    return state.next_item[world, item]


@device_function
def put_into_cell(model: Any, state: Any, world: int, item: int, position: Any):
    """Put an item into the grid, in front of the other items of its cell."""
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


@outlined
def sort_into_cells(model: Any, state: Any, world: int):
    """Fill the grid of a world with the present positions."""
    if model.cells.across > 1:
        clear_cells(model, state, world)
        for agent in range(model.agents):
            put_into_cell(model, state, world, agent, state.position[world, agent])


@device_function
def has_body(model: Any, state: Any, world: int, item: int) -> bool:
    """Return whether an item is present and is a box, not a point."""
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


NOT_A_NEIGHBOUR = wp.constant(wp.uint8(Sight.NOT_A_NEIGHBOUR))


@wp.func
def entry_count(model: Any, state: Any, world: int, vehicle: int) -> int:
    """Return the number of entries with targets, and in worlds with `kept` also with senders that are no targets."""
    if model.kept == 0:
        return model.target_count[vehicle]
    return state.kept_count[world, vehicle]


@wp.func
def entry_at(model: Any, state: Any, kept: int, world: int, vehicle: int, n: int) -> int:
    """Return the n-th of these entries, in the order of the agents; `kept` is the model's, read once per loop."""
    if kept == 0:
        return model.targets[vehicle, n]
    return state.kept_order[world, vehicle, n]


@wp.func
def agent_of(state: Any, kept: int, world: int, vehicle: int, entry: int) -> int:
    """Return the agent of an entry; `kept` as for `entry_at`."""
    if kept == 0:
        return entry
    return state.kept_agent[world, vehicle, entry]


@wp.func
def box_of_entry(model: Any, entry: int) -> int:
    """Return the box of messages of an entry; below 0 for a landmark of worlds that keep all."""
    return entry - model.before_boxes


@device_function
def sender_of(model: Any, state: Any, world: int, vehicle: int, box: int) -> int:
    """Return the sender of a box; below 0: none."""
    if model.kept == 0:
        return box
    if box >= model.kept:
        return -1
    return state.kept_agent[world, vehicle, box] - model.landmarks


@device_function
def kept_before(model: Any, state: Any, world: int, vehicle: int, agent: int) -> int:
    """Return how many of the agents that a vehicle keeps have lower numbers than an agent."""
    low = int(0)
    high = state.kept_count[world, vehicle]
    while low < high:
        middle = (low + high) // 2
        if state.kept_agent[world, vehicle, state.kept_order[world, vehicle, middle]] < agent:
            low = middle + 1
        else:
            high = middle
    return low


@device_function
def entry_of(model: Any, state: Any, world: int, vehicle: int, agent: int) -> int:
    """Return the entry of an agent; -1: it is not kept."""
    if model.kept == 0:
        return agent
    n = kept_before(model, state, world, vehicle, agent)
    if n < state.kept_count[world, vehicle]:
        entry = state.kept_order[world, vehicle, n]
        if state.kept_agent[world, vehicle, entry] == agent:
            return entry
    return -1


@device_function
def box_of(model: Any, state: Any, world: int, vehicle: int, sender: int) -> int:
    """Return the box of a sender; senders that are not kept share the last one."""
    if model.kept == 0:
        return sender
    entry = entry_of(model, state, world, vehicle, model.landmarks + sender)
    return wp.where(entry < 0, model.kept, entry)


@wp.func
def is_target(model: Any, vehicle: int, agent: int) -> bool:
    """Return whether a vehicle may measure an agent that it keeps."""
    return model.listed == 1 or model.acyclic == 0 or agent < model.landmarks + vehicle


@device_function
def clear_entry(state: Any, world: int, vehicle: int, entry: int):
    """Clear the measurements of an agent."""
    o = type(state.bearing[world, vehicle, entry])()
    state.bearing[world, vehicle, entry] = o
    state.bearing_tick[world, vehicle, entry] = -1
    state.sight[world, vehicle, entry] = NOT_A_NEIGHBOUR
    for sensor in range(state.reading_tick.shape[2]):
        state.reading_tick[world, vehicle, sensor, entry] = -1


@device_function
def clear_box(state: Any, world: int, vehicle: int, box: int):
    """Clear the messages received from a sender."""
    o = type(state.inbox_position[world, vehicle, box])()
    state.arriving[world, vehicle, box] = -1
    state.inbox_tick[world, vehicle, box] = -1
    state.inbox_stamp[world, vehicle, box] = -1
    state.inbox_seen[world, vehicle, box] = -1
    state.inbox_pose_only[world, vehicle, box] = 0
    state.inbox_position[world, vehicle, box] = o
    state.inbox_rotation[world, vehicle, box] = identity3(o)
    state.inbox_std[world, vehicle, box] = o[0]


@device_function
def clear_entries(model: Any, state: Any, world: int, vehicle: int):
    """Clear a vehicle's measurements and received messages."""
    for entry in range(state.sight.shape[2]):
        clear_entry(state, world, vehicle, entry)
    for box in range(state.inbox_tick.shape[2]):
        clear_box(state, world, vehicle, box)
    state.kept_count[world, vehicle] = 0
    if model.listed * model.kept > 0:
        state.kept_count[world, vehicle] = model.target_count[vehicle]
    for entry in range(model.kept):
        state.kept_order[world, vehicle, entry] = entry
        state.kept_agent[world, vehicle, entry] = -1
        if model.listed == 1:
            state.kept_agent[world, vehicle, entry] = model.targets[vehicle, entry]


@device_function
def camera_reach(model: Any, state: Any, world: int, vehicle: int):
    """Return the largest distance (m) of an agent that a vehicle's camera can see."""
    camera = model.camera[vehicle]
    place = camera.position + state.camera_shift[world, vehicle]
    reach = camera.range * state.parameter[world, CAMERA_RANGE] + wp.length(place) + model.marker_reach
    return reach * type(reach)(1.001)  # against rounding


@device_function
def beyond(model: Any, state: Any, world: int, vehicle: int, agent: int, seen: Any):
    """Return by how much an agent is out of range of a vehicle, m; `seen` is the reach of its camera."""
    reach = seen
    if agent >= model.landmarks:
        reach = wp.max(reach, model.radio.range)
    offset = state.position[world, agent] - state.position[world, model.landmarks + vehicle]
    more = wp.length(offset) - reach
    if state.present[world, agent] == 0:
        more = type(more)(wp.inf)
    return more


@device_function
def place_of_farthest(model: Any, state: Any, world: int, vehicle: int, seen: Any) -> int:
    """Return the place in the order of the agent that is farthest out of range; -1: all are in range."""
    found = int(-1)
    most = type(seen)(0.0)
    for n in range(model.kept):
        agent = state.kept_agent[world, vehicle, state.kept_order[world, vehicle, n]]
        more = beyond(model, state, world, vehicle, agent, seen)
        if more > most:
            found = n
            most = more
    return found


@device_function
def keep(model: Any, state: Any, world: int, vehicle: int, agent: int, seen: Any):
    """Keep an agent in range; a lack of room is noted until the next reset from the host."""
    if entry_of(model, state, world, vehicle, agent) >= 0:
        return
    count = state.kept_count[world, vehicle]
    entry = count
    if count == model.kept:
        last = place_of_farthest(model, state, world, vehicle, seen)
        if last < 0:
            state.crowded[world, vehicle] = 1
            return
        entry = state.kept_order[world, vehicle, last]
        count -= 1
        for n in range(last, count):
            state.kept_order[world, vehicle, n] = state.kept_order[world, vehicle, n + 1]
        state.kept_count[world, vehicle] = count
    at = kept_before(model, state, world, vehicle, agent)
    for back in range(count - at):
        n = count - back
        state.kept_order[world, vehicle, n] = state.kept_order[world, vehicle, n - 1]
    state.kept_order[world, vehicle, at] = entry
    state.kept_agent[world, vehicle, entry] = agent
    state.kept_count[world, vehicle] = count + 1
    clear_entry(state, world, vehicle, entry)
    clear_box(state, world, vehicle, entry)


@device_function
def keep_those_in_range(model: Any, state: Any, world: int, vehicle: int):
    """Keep all agents in range that a vehicle may measure or receive; the grid is that of this tick."""
    if model.kept == 0 or model.listed == 1:
        return
    own = model.landmarks + vehicle
    if state.present[world, own] == 0:
        return
    here = state.position[world, own]
    seen = camera_reach(model, state, world, vehicle)
    last = last_of_all(model)
    x, y, columns, rows = window_about(model, here, here, wp.max(seen, model.radio.range))
    for row in range(rows):
        for column in range(columns):
            agent = first_in(model, state, world, cell_at(model, x + column, y + row))
            while agent >= 0:
                if agent < model.agents and agent != own:
                    if is_target(model, vehicle, agent) or model.radio.to_all == 1:
                        if beyond(model, state, world, vehicle, agent, seen) <= seen - seen:
                            keep(model, state, world, vehicle, agent, seen)
                agent = next_in(model, state, world, agent, last)
