"""How near a heard vehicle will come: its closest point of approach, where one goes along a way that bends."""

import warp as wp

FORESIGHT = wp.constant(6.0)
"""s ahead."""
FAR = wp.constant(4.0)
"""m; what is farther, or not heard, is as far as this."""


@wp.func
def nearest_on_leg(apart: wp.vec2, away: wp.vec2, duration: wp.float32) -> wp.float32:
    """Return the least distance, m, of two that are so far apart now and part at that velocity, within a time."""
    time = wp.clamp(-wp.dot(apart, away) / wp.max(wp.length_sq(away), 1.0e-9), 0.0, duration)
    return wp.length(apart + time * away)


@wp.func
def nearest_going(ahead: wp.vec4, step: wp.float32, speed: wp.float32, place: wp.vec2, forward: wp.vec2):
    """Return how near another comes if both go on at a speed, oneself along the way and the other straight on.

    Args:
        ahead: directions of the way 1, 2, 4 and 8 steps ahead, rad to the left.
        step: m.
        speed: of both, m/s, above 0.
        place: of the other, m, body frame.
        forward: the direction of the other, body frame.
    """
    near, begin, at = FAR, 0.0, wp.vec2()
    for k in range(4):
        if begin < FORESIGHT:
            to = step * wp.vec2(wp.cos(ahead[k]), wp.sin(ahead[k]))
            time = step / speed - begin
            velocity = (to - at) / time
            duration = wp.where(k == 3, FORESIGHT, wp.min(step / speed, FORESIGHT)) - begin
            apart = place + begin * speed * forward - at
            near = wp.min(near, nearest_on_leg(apart, speed * forward - velocity, duration))
            begin += time
            at = to
            step += step
    return near


@wp.func
def nearest_waiting(speed: wp.float32, place: wp.vec2, forward: wp.vec2):
    """Return how near another comes that goes straight on, if one stands; arguments as of `nearest_going`."""
    return wp.min(FAR, nearest_on_leg(place, speed * forward, FORESIGHT))
