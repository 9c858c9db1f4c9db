"""Terms of `lane_keeping.toml`: functions of the records of `coopenv.api.terms.records`, which Warp compiles."""

import warp as wp

LANE = 1.0  # x of the lane's middle, m
ROAD = 3.0  # half width of the road, m


def lane_offset(ego):
    """Estimated position across the lane, m."""
    return ego.position_estimate[0] - LANE


def lane(ego):
    """Minus the squared distance from the lane's middle, m^2."""
    offset = ego.position_estimate[0] - LANE
    return -offset * offset


def off_the_road(ego, truth):
    """Return 1 if the car has left the road."""
    return wp.abs(truth.position[0]) > ROAD
