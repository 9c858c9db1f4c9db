"""V2X: pose estimates travel with delay, period, loss and limited range; faults change the messages.

Messages of observers on the host are `coopenv.observers.contract.Message`; here is when they arrive.

Faults of computers, clocks, maps and messages are drawn at a reset. With all of them off, nothing is drawn and nothing
is changed. Besides the time of sending, a message has two times: its content's (`content_tick`, earlier where the
sender replays) and its time stamp (`stamp`), wrong by the clocks' offsets.
"""

from typing import Any

import warp as wp

from coopenv.estimation import COLLUDE, HONEST, REPLAY
from coopenv.estimation.linalg import exp_so3, identity3, join6
from coopenv.world.camera import VISIBLE, mapped_position
from coopenv.world.nearby import agent_of, box_of_entry, entry_at, entry_count, sender_of
from coopenv.world.random import (
    CLOCK,
    CORRUPTION,
    JAMMER,
    LIE,
    MAP_ERROR,
    RADIO,
    RESTART,
    V2X_LOSS,
    gaussian_pair,
    pair,
    random_words,
    signed_uniform,
    uniform,
)
from coopenv.world.warp_internals import device_function, outlined

NEVER = wp.constant(-1)
NOTHING = wp.constant(0)
POSE = wp.constant(1)
REPORT = wp.constant(2)
"""Contents of a message for a receiver."""
POSE_BYTES = wp.constant(56)
"""Three numbers of 8 bytes, and a quaternion."""
MOST_CLOCK_TICKS = wp.constant(1.0e8)


@outlined
def draw_faults(model: Any, state: Any, world: int, vehicle: int):
    """Draw the faults of a vehicle in an episode."""
    o = type(state.broadcast_shift[world, vehicle])()
    state.clock[world, vehicle] = 0
    state.restart_tick[world, vehicle] = NEVER
    state.lie_tick[world, vehicle] = NEVER
    state.lie_offset[world, vehicle] = o
    state.lie_velocity[world, vehicle] = o
    state.jammer_tick[world, vehicle] = NEVER
    state.broadcast_shift[world, vehicle] = o
    state.broadcast_turn[world, vehicle] = o
    if model.clocks == 1:
        draw_clock(model, state, world, vehicle, o)
    if model.restarts == 1:
        draw_restart(model, state, world, vehicle, o)
    if model.fault[vehicle].lie != HONEST:
        draw_lie(model, state, world, vehicle, o)
    if model.jammers == 1:
        draw_jammer(model, state, world, vehicle, o)
    for landmark in range(wp.min(model.landmarks, state.map_tick.shape[2])):
        state.map_tick[world, vehicle, landmark] = NEVER
        state.map_error[world, vehicle, landmark] = o
        if model.map_errors == 1:
            draw_map_error(model, state, world, vehicle, landmark, o)


@wp.func
def first_tick_of(model: Any, start: Any, spread: Any, word: wp.uint32) -> int:
    """Return the first tick of a fault that begins at `start`, or at most `spread` later, both in s."""
    time = wp.float64(start + spread * uniform(word, type(start)(1.0)))
    ticks = wp.min(time * model.camera_rate, wp.float64(model.horizon_ticks) + wp.float64(1.0))
    return int(wp.ceil(ticks - wp.float64(1.0e-6)))


@wp.func
def drawn_direction(given: Any, word: wp.uint32):
    """Return a direction of length 1: the given one, or if that is zero a drawn horizontal one."""
    direction = given
    if wp.length_sq(given) == given.dtype(0.0):
        angle = given.dtype(6.283185307179586) * uniform(word, given.dtype(1.0))
        direction = type(given)(wp.cos(angle), wp.sin(angle), given.dtype(0.0))
    return direction


@wp.func
def draw_clock(model: Any, state: Any, world: int, vehicle: int, o: Any):
    """Draw by how many ticks a vehicle's clock is ahead."""
    words = random_words(state.seed[world], state.episode[world], 0, vehicle, CLOCK)
    off, _ = gaussian_pair(words[0], words[1], o.dtype(1.0))
    ticks = wp.round(off * model.fault[vehicle].clock * o.dtype(model.camera_rate))
    most = o.dtype(MOST_CLOCK_TICKS)
    state.clock[world, vehicle] = int(wp.clamp(ticks, -most, most))


@wp.func
def draw_restart(model: Any, state: Any, world: int, vehicle: int, o: Any):
    """Draw the tick of a vehicle's restart, the first of a decision."""
    fault = model.fault[vehicle]
    one = o.dtype(1.0)
    words = random_words(state.seed[world], state.episode[world], 0, vehicle, RESTART)
    if uniform(words[0], one) < fault.restart_chance:
        time = wp.float64(fault.restart_time + fault.restart_time_spread * uniform(words[1], one))
        ticks = wp.min(time * model.camera_rate, wp.float64(model.horizon_ticks) + wp.float64(1.0))
        decisions = int(wp.ceil(ticks / wp.float64(model.ticks_per_decision) - wp.float64(1.0e-6)))
        state.restart_tick[world, vehicle] = 1 + model.ticks_per_decision * wp.max(decisions, 1)


@wp.func
def draw_lie(model: Any, state: Any, world: int, vehicle: int, o: Any):
    """Draw the tick from which a vehicle lies, and its offset of the position, equal for all colluding vehicles."""
    fault = model.fault[vehicle]
    subject = wp.where(fault.lie == COLLUDE, model.vehicles, vehicle)
    words = random_words(state.seed[world], state.episode[world], 0, subject, LIE)
    if uniform(words[0], o.dtype(1.0)) < fault.lie_chance:
        state.lie_tick[world, vehicle] = first_tick_of(model, fault.lie_start, fault.lie_start_spread, words[1])
        direction = drawn_direction(fault.lie_direction, words[2])
        state.lie_offset[world, vehicle] = fault.lie_offset * direction
        state.lie_velocity[world, vehicle] = fault.lie_speed * direction


@wp.func
def draw_jammer(model: Any, state: Any, world: int, vehicle: int, o: Any):
    """Draw from which tick a vehicle's jammer is on."""
    fault = model.fault[vehicle]
    words = random_words(state.seed[world], state.episode[world], 0, vehicle, JAMMER)
    if uniform(words[0], o.dtype(1.0)) < fault.jammer_chance:
        begin = first_tick_of(model, fault.jammer_start, fault.jammer_start_spread, words[1])
        state.jammer_tick[world, vehicle] = begin


@wp.func
def draw_map_error(model: Any, state: Any, world: int, vehicle: int, landmark: int, o: Any):
    """Draw the tick from which a landmark is off on a vehicle's map, and the offset; the same for all vehicles."""
    fault = model.fault[vehicle]
    one = o.dtype(1.0)
    words = random_words(state.seed[world], state.episode[world], 0, landmark, MAP_ERROR)
    concerned = fault.map_error_landmark < 0 or fault.map_error_landmark == landmark
    if concerned and uniform(words[0], one) < fault.map_error_chance:
        offset = fault.map_error_offset + fault.map_error_offset_spread * uniform(words[3], one)
        begin = first_tick_of(model, fault.map_error_start, fault.map_error_start_spread, words[1])
        state.map_tick[world, vehicle, landmark] = begin
        state.map_error[world, vehicle, landmark] = offset * drawn_direction(fault.map_error_direction, words[2])


@wp.func
def is_lying(state: Any, world: int, vehicle: int, tick: int) -> bool:
    """Return whether a vehicle's message of a tick is a lie."""
    return state.lie_tick[world, vehicle] >= 0 and tick >= state.lie_tick[world, vehicle]


@outlined
def alter(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Decide the difference between a vehicle's broadcast pose and its estimate at a tick."""
    if model.alters == 0:
        return
    fault = model.fault[vehicle]
    shift = type(state.broadcast_shift[world, vehicle])()
    turn = type(shift)()
    one = shift.dtype(1.0)
    if is_lying(state, world, vehicle, tick):
        since = wp.float64(tick - state.lie_tick[world, vehicle]) * model.camera_period
        shift = state.lie_offset[world, vehicle] + state.lie_velocity[world, vehicle] * shift.dtype(since)
        if fault.lie != REPLAY:
            turn[2] = fault.lie_turn
    time = wp.float64(tick) * model.camera_period
    if fault.corruption_probability > one - one and time >= wp.float64(fault.corruption_start):
        words = random_words(state.seed[world], state.episode[world], tick, vehicle, CORRUPTION)
        if uniform(words[3], one) < fault.corruption_probability:
            more = random_words(state.seed[world], state.episode[world], tick, vehicle, CORRUPTION + wp.uint32(1))
            for axis in range(3):
                shift[axis] += fault.corruption_size * signed_uniform(words[axis], one)
                turn[axis] += fault.corruption_turn * signed_uniform(more[axis], one)
    state.broadcast_shift[world, vehicle] = shift
    state.broadcast_turn[world, vehicle] = turn


@wp.func
def as_broadcast(model: Any, state: Any, world: int, vehicle: int, R: Any, position: Any):
    """Return the pose that a vehicle broadcasts at this tick in place of (R, position), in their precision."""
    sent_R = R
    sent_position = position
    if model.alters == 1:
        sent_position = position + type(position)(state.broadcast_shift[world, vehicle])
        turn = type(position)(state.broadcast_turn[world, vehicle])
        if wp.length_sq(turn) > turn.dtype(0.0):
            sent_R = R * exp_so3(turn)
    return sent_R, sent_position


@wp.func
def odometry_as_broadcast(model: Any, state: Any, world: int, vehicle: int, R: Any, R_odometry: Any, p_odometry: Any):
    """Return the dead reckoning that a vehicle broadcasts for (R_odometry, p_odometry), at the attitude R.

    With a consistent `lie` it leads to the broadcast poses.
    """
    sent_R = R_odometry
    sent_p = p_odometry
    if model.alters == 1 and model.fault[vehicle].lie_consistent == 1:
        sent_p = p_odometry + R_odometry * wp.transpose(R) * type(p_odometry)(state.broadcast_shift[world, vehicle])
        turn = type(p_odometry)(state.broadcast_turn[world, vehicle])
        if wp.length_sq(turn) > turn.dtype(0.0):
            sent_R = R_odometry * exp_so3(turn)
    return sent_R, sent_p


@wp.func
def claimed_std(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Return the standard deviations that a lying sender claims for its pose, rad and m; 0: its own."""
    std = model.fault[vehicle].lie_std
    if model.alters == 0 or not is_lying(state, world, vehicle, tick):
        std = type(std)(0.0)
    return std


@wp.func
def content_tick(model: Any, state: Any, world: int, sender: int, sent: int) -> int:
    """Return the tick at which the content of a message was made: earlier than `sent` under the fault `replay`."""
    if model.alters == 1 and model.fault[sender].lie == REPLAY and is_lying(state, world, sender, sent):
        old = wp.max(sent - model.fault[sender].lie_replay, 0)
        if state.outbox_tick[world, sender, old % model.radio.slots] == old:
            return old
    return sent


@wp.func
def stamp(model: Any, state: Any, world: int, receiver: int, sender: int, sent: int, tick: int) -> int:
    """Return the tick of sending of a message by the receiver's clock; both clocks may be off."""
    if model.clocks == 0:
        return sent
    return wp.clamp(sent + state.clock[world, sender] - state.clock[world, receiver], 0, tick)


@wp.func
def forget_everything(model: Any, state: Any, world: int, vehicle: int):
    """Reset a restarting vehicle to the knowledge of its computer: the map alone.

    Its estimate is the mean of the landmarks, in the map's axes; its inbox is empty.
    """
    o = type(state.broadcast_shift[world, vehicle])()
    i3 = identity3(o)
    middle = type(o)()
    for landmark in range(model.landmarks):
        middle += mapped_position(model, state, world, vehicle, landmark) / o.dtype(model.landmarks)
    state.estimate_rotation[world, vehicle] = i3
    state.estimate_position[world, vehicle] = middle
    none = i3 - i3
    state.covariance[world, vehicle] = join6(model.observer.p1 * i3, none, none, model.observer.p2 * i3)
    state.corrected_tick[world, vehicle] = state.tick[world]
    state.nis_dof[world, vehicle] = 0
    for box in range(state.inbox_tick.shape[2]):
        state.inbox_tick[world, vehicle, box] = -1
        state.inbox_stamp[world, vehicle, box] = -1


@wp.func
def has_restarted(model: Any, state: Any, world: int, vehicle: int) -> bool:
    """Return whether a vehicle has restarted in this episode, before the next tick."""
    begun = state.restart_tick[world, vehicle]
    return model.restarts == 1 and begun > 0 and state.tick[world] + 1 >= begun


@wp.func
def start_covariance(model: Any, state: Any, world: int, vehicle: int):
    """Return the covariance of the estimate that a vehicle's observer starts from, LEFT coordinates, rad and m."""
    row = vehicle
    if has_restarted(model, state, world, vehicle):
        row = model.vehicles + vehicle
    return model.start.covariance[row]


@outlined
def broadcast(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Broadcast a vehicle's estimate (Rhat, Rhat phat), and when it last measured each vehicle.

    It does so if a message is due and the vehicle is present and has a radio.
    """
    slot = tick % model.radio.slots
    sent = int(-1)
    sends = state.present[world, model.landmarks + vehicle] != 0 and model.radio.connected[vehicle] != 0
    if tick % model.radio.period == 0 and sends:
        sent = tick
        R = state.estimate_rotation[world, vehicle]
        position = R * state.estimate_position[world, vehicle]
        sent_R, sent_position = as_broadcast(model, state, world, vehicle, R, position)
        state.outbox_rotation[world, vehicle, slot] = sent_R
        state.outbox_position[world, vehicle, slot] = sent_position
        for other in range(state.outbox_seen.shape[3]):
            target = model.landmarks + other
            measured = state.bearing_tick[world, vehicle, target]
            if state.sight[world, vehicle, target] == VISIBLE:
                measured = tick  # where a frame was exposed earlier, this message is the first with it
            state.outbox_seen[world, vehicle, slot, other] = measured
            state.outbox_content[world, vehicle, slot, other] = chosen_content(model, state, world, vehicle, other)
    state.outbox_tick[world, vehicle, slot] = sent


@device_function
def chosen_content(model: Any, state: Any, world: int, vehicle: int, receiver: int) -> int:
    """Return the contents of a vehicle's message to a receiver by its action; without `action.radio`, REPORT."""
    if receiver == vehicle:
        return NOTHING
    content = REPORT
    if model.radio.entry > 0:
        entry = state.action[world, vehicle, model.radio.entry + wp.where(receiver > vehicle, receiver - 1, receiver)]
        if entry <= type(entry)(0.5):
            content = wp.where(entry > type(entry)(0.0), POSE, NOTHING)
    return content


@device_function
def count_bytes(model: Any, state: Any, world: int, vehicle: int, tick: int):
    """Count a vehicle's messages of a tick, after its estimator has set the size of its report."""
    slot = tick % model.radio.slots
    if state.outbox_tick[world, vehicle, slot] != tick:
        return
    receivers = state.outbox_content.shape[3]
    sent = wp.where(receivers == 0, state.report_size[world, vehicle], 0)
    for receiver in range(receivers):
        content = state.outbox_content[world, vehicle, slot, receiver]
        size = wp.where(content == POSE, POSE_BYTES, wp.where(content == REPORT, state.report_size[world, vehicle], 0))
        sent = wp.where(model.radio.entry > 0, sent + size, wp.max(sent, size))
    state.bytes_sent[world, vehicle] += sent


@device_function
def put_into_inbox(model: Any, state: Any, world: int, receiver: int, box: int, sender: int, sent: int, tick: int):
    """Copy a sender's message into its box at the receiver, unless the message there has a later stamp.

    Stamps are by clocks that may be off.
    """
    stamped = stamp(model, state, world, receiver, sender, sent, tick)
    if model.clocks == 1 and stamped <= state.inbox_stamp[world, receiver, box]:
        return
    made = content_tick(model, state, world, sender, sent)
    slot = made % model.radio.slots
    state.inbox_rotation[world, receiver, box] = state.outbox_rotation[world, sender, slot]
    state.inbox_position[world, receiver, box] = state.outbox_position[world, sender, slot]
    state.inbox_std[world, receiver, box] = state.outbox_std[world, sender, slot]
    state.inbox_tick[world, receiver, box] = sent
    state.inbox_stamp[world, receiver, box] = stamped
    if model.kept == 0:
        seen = state.outbox_seen[world, sender, slot, receiver]
        content = state.outbox_content[world, sender, sent % model.radio.slots, receiver]
        state.inbox_pose_only[world, receiver, box] = wp.where(content == POSE, 1, 0)
        state.inbox_seen[world, receiver, box] = wp.where(seen < 0, -1, wp.max(seen + stamped - made, 0))


@outlined
def transmit(model: Any, state: Any, world: int, receiver: int, tick: int):
    """Decide which messages arrive at a receiver at a tick, by the scenario's radio: write when they were sent, or -1.

    With delay 0 a follower receives its leaders' estimates of this very tick; a sender later in the order than
    its receiver (possible only without the acyclic restriction) is received one tick late.
    """
    here = state.position[world, model.landmarks + receiver]
    for box in range(state.arriving.shape[2]):
        state.arriving[world, receiver, box] = -1
    if model.radio.connected[receiver] == 0 or is_jammed(model, state, world, here, tick):
        return
    kept = model.kept
    every = model.radio.to_all == 1 and kept == 0
    for n in range(wp.where(every, model.vehicles, entry_count(model, state, world, receiver))):
        entry = model.landmarks + n
        if not every:
            entry = entry_at(model, state, kept, world, receiver, n)
        sender = agent_of(state, kept, world, receiver, entry) - model.landmarks
        if sender >= 0 and sender != receiver:
            lag = model.radio.delay
            if lag == 0 and model.rank[sender] > model.rank[receiver]:
                lag = int(1)
            due = tick - lag
            there = state.position[world, model.landmarks + sender]
            if due >= 0 and due % model.radio.period == 0 and not wp.length(there - here) > model.radio.range:
                if not is_lost(model, state, world, receiver, sender, tick):
                    state.arriving[world, receiver, box_of_entry(model, entry)] = due


@device_function
def is_jammed(model: Any, state: Any, world: int, place: Any, tick: int) -> bool:
    """Return whether a receiver at a place is in the range of a jammer that is on at a tick."""
    if model.jammers == 0:
        return False
    for vehicle in range(model.vehicles):
        fault = model.fault[vehicle]
        begun = state.jammer_tick[world, vehicle]
        if begun >= 0 and tick >= begun:
            since = wp.float64(tick - begun) * model.camera_period + wp.float64(1.0e-9)
            share = since / fault.jammer_period
            on = since < fault.jammer_duration and share - wp.floor(share) < fault.jammer_duty
            source = fault.jammer_position
            if fault.jammer_fixed == 0:
                source = state.position[world, model.landmarks + vehicle]
                on = on and state.present[world, model.landmarks + vehicle] != 0
            if on and not wp.length(source - place) > fault.jammer_range:
                return True
    return False


@device_function
def is_lost(model: Any, state: Any, world: int, receiver: int, sender: int, tick: int) -> bool:
    """Draw whether the radio loses the message that arrives at a receiver at a tick."""
    loss = model.radio.loss * state.parameter[world, V2X_LOSS]
    if loss > type(loss)(0.0):
        words = random_words(state.seed[world], state.episode[world], tick, pair(receiver, sender), RADIO)
        return uniform(words[0], loss) < loss
    return False


@outlined
def deliver(model: Any, state: Any, world: int, receiver: int, tick: int):
    """Receive the messages arriving at this tick, and decide the claims of the own message."""
    alter(model, state, world, receiver, tick)
    for box in range(state.arriving.shape[2]):
        sent = state.arriving[world, receiver, box]
        if sent >= 0:
            slot = sent % model.radio.slots
            sender = box
            addressed = bool(True)
            if model.kept > 0:
                sender = sender_of(model, state, world, receiver, box)
            else:
                addressed = state.outbox_content[world, sender, slot, receiver] != NOTHING
            if addressed and state.outbox_tick[world, sender, slot] == sent:
                put_into_inbox(model, state, world, receiver, box, sender, sent, tick)


@device_function
def fresh(model: Any, state: Any, world: int, receiver: int, box: int, tick: int) -> bool:
    """Return whether a message has been received in a box and is not older than the staleness limit."""
    sent = state.inbox_stamp[world, receiver, box]
    if sent < 0:
        return False
    return wp.float64(tick - sent) / model.camera_rate <= model.radio.staleness
