"""Counter-based random numbers (Philox4x32-7; Salmon, Moraes, Dror, Shaw, SC 2011) and the parameters of a world.

A draw is a pure function of (seed, episode, index, subject, stream), so a world's noise does not depend on the
batch size, the order of execution or the device. `index` is a tick or a sample number, `subject` packs the agents
concerned, and `stream` is one of the constants below.

Parameters of a world are factors: drawn at a reset, dependent on the difficulty, or set.
"""

from typing import Any

import warp as wp

from coopenv.scenario.difficulty import PARAMETERS
from coopenv.world.warp_internals import outlined

vec4u = wp.types.vector(4, wp.uint32)

ROUNDS = wp.constant(7)  # the fewest that the authors found to pass BigCrush; their ten cost 6 % of a camera tick
MULTIPLIER_0 = wp.constant(wp.uint64(0xD2511F53))
MULTIPLIER_1 = wp.constant(wp.uint64(0xCD9E8D57))
WEYL_0 = wp.constant(wp.uint32(0x9E3779B9))
WEYL_1 = wp.constant(wp.uint32(0xBB67AE85))

RESET_POSE = wp.constant(wp.uint32(1))
RESET_ESTIMATE_POSITION = wp.constant(wp.uint32(2))
RESET_ESTIMATE_ORIENTATION = wp.constant(wp.uint32(3))
ODOMETRY = wp.constant(wp.uint32(4))
BEARING = wp.constant(wp.uint32(6))
RADIO = wp.constant(wp.uint32(7))
ROUTE = wp.constant(wp.uint32(8))
ROUTE_SHAPE = wp.constant(wp.uint32(9))
NEXT_ROUTE = wp.constant(wp.uint32(10))
LANDMARK = wp.constant(wp.uint32(11))
PRESENCE = wp.constant(wp.uint32(12))
PARAMETER = wp.constant(wp.uint32(13))
INITIAL_SPEED = wp.constant(wp.uint32(14))
RESET_ODOMETRY = wp.constant(wp.uint32(32))
RESET_CAMERA = wp.constant(wp.uint32(34))
ODOMETRY_WALK = wp.constant(wp.uint32(36))
SLIP = wp.constant(wp.uint32(38))
RESET_LENS = wp.constant(wp.uint32(40))
CLOCK = wp.constant(wp.uint32(41))
RESTART = wp.constant(wp.uint32(42))
LIE = wp.constant(wp.uint32(43))
CORRUPTION = wp.constant(wp.uint32(44))
MAP_ERROR = wp.constant(wp.uint32(46))
JAMMER = wp.constant(wp.uint32(47))
CAMERA_FRAME = wp.constant(wp.uint32(48))
BEARING_DRIFT = wp.constant(wp.uint32(49))
MAP_ACCURACY = wp.constant(wp.uint32(50))
"""For six numbers, the next stream gives the second half."""
SENSOR = wp.constant(wp.uint32(64))
STREAMS_PER_SENSOR = wp.constant(wp.uint32(16))
"""Streams of sensors beside the camera: the first, and how many each one has, see `coopenv.world.sensors`."""


@outlined
def philox(counter: vec4u, key0: wp.uint32, key1: wp.uint32) -> vec4u:
    """Return four independent 32-bit words for a 128-bit counter and a 64-bit key."""
    c = counter
    k0 = key0
    k1 = key1
    for _ in range(ROUNDS):
        product0 = MULTIPLIER_0 * wp.uint64(c[0])
        product1 = MULTIPLIER_1 * wp.uint64(c[2])
        high0 = wp.uint32(product0 >> wp.uint64(32))
        high1 = wp.uint32(product1 >> wp.uint64(32))
        c = vec4u(high1 ^ c[1] ^ k0, wp.uint32(product1), high0 ^ c[3] ^ k1, wp.uint32(product0))
        k0 = k0 + WEYL_0
        k1 = k1 + WEYL_1
    return c


@wp.func
def random_words(seed: wp.uint64, episode: wp.uint32, index: int, subject: int, stream: wp.uint32) -> vec4u:
    """Return four random words of one stream."""
    counter = vec4u(wp.uint32(index), wp.uint32(subject), stream, episode)
    return philox(counter, wp.uint32(seed), wp.uint32(seed >> wp.uint64(32)))


@wp.func
def pair(vehicle: int, other: int) -> int:
    """Return the subject of random numbers of a pair of a vehicle and another agent."""
    return vehicle * 65536 + other


CELL_SHIFT = wp.constant(wp.uint32(28))
"""Sixteen cells per axis: the first four bits of a word are the cell of the number drawn from it."""


@wp.func
def on_cells(words: vec4u, seed: wp.uint64, first: bool, second: bool, third: bool) -> vec4u:
    """Return random words for a position whose grid-cell indices have the parity of a set (training or held-out).

    The sum of the indices is even in training worlds and odd in evaluation worlds (bit 31 of the key), so that the two
    sets share no cell. Each coordinate alone stays uniform: a wrong parity is corrected by the neighbouring cell along
    the last axis, for half of the values of the other axes.
    """
    one = wp.uint32(1)
    odd = wp.uint32(seed >> wp.uint64(31)) & one
    result = words
    last = int(-1)
    for axis in range(3):
        if (axis == 0 and first) or (axis == 1 and second) or (axis == 2 and third):
            odd = odd ^ ((words[axis] >> CELL_SHIFT) & one)
            last = axis
    if last >= 0 and odd == one:
        result[last] = words[last] ^ (one << CELL_SHIFT)
    return result


@wp.func
def uniform(word: wp.uint32, one: Any):
    """Return a number in (0, 1), in the precision of `one`."""
    u = (type(one)(word) + type(one)(0.5)) * type(one)(2.3283064365386963e-10)
    return wp.min(u, type(one)(0.99999994))  # the largest float32 below 1, to which the largest words would round


@wp.func
def signed_uniform(word: wp.uint32, one: Any):
    """Return a number in (-1, 1)."""
    return uniform(word, one) * type(one)(2.0) - one


@wp.func
def gaussian_pair(word0: wp.uint32, word1: wp.uint32, one: Any):
    """Return two independent standard normal numbers (Box-Muller).

    The angle is drawn within a quadrant and two bits choose the quadrant: one sine per pair, no cosine.
    """
    radius = wp.sqrt(type(one)(-2.0) * wp.log(uniform(word0, one)))
    angle = (type(one)(word1 >> wp.uint32(2)) + type(one)(0.5)) * type(one)(1.4629180792671596e-09)  # pi/2 / 2^30
    sine = wp.sin(angle)
    cosine = wp.sqrt(wp.max(one - sine * sine, type(one)(0.0)))
    if (word1 & wp.uint32(1)) != wp.uint32(0):
        sine = -sine
    if (word1 & wp.uint32(2)) != wp.uint32(0):
        cosine = -cosine
    return radius * cosine, radius * sine


@wp.func
def four_gaussians(words: vec4u, zero: Any):
    """Return a vector of three independent standard normal numbers, in the type of `zero`, and a fourth number."""
    one = zero.dtype(1.0)
    x, y = gaussian_pair(words[0], words[1], one)
    z, more = gaussian_pair(words[2], words[3], one)
    return type(zero)(x, y, z), more


@wp.func
def six_gaussians(seed: wp.uint64, episode: wp.uint32, index: int, subject: int, stream: wp.uint32, zero: Any):
    """Return two vectors of three independent standard normal numbers each, in the type of `zero`.

    They are drawn from a stream and the next one.
    """
    a = random_words(seed, episode, index, subject, stream)
    b = random_words(seed, episode, index, subject, stream + wp.uint32(1))
    first, x = four_gaussians(a, zero)
    y, z = gaussian_pair(b[0], b[1], zero.dtype(1.0))
    return first, type(zero)(x, y, z)


@wp.func
def unit_vector(word0: wp.uint32, word1: wp.uint32, zero: Any):
    """Return a direction uniform on the sphere."""
    one = zero.dtype(1.0)
    z = signed_uniform(word0, one)
    r = wp.sqrt(wp.max(one - z * z, zero.dtype(0.0)))
    angle = uniform(word1, one) * zero.dtype(6.283185307179586)
    return type(zero)(r * wp.cos(angle), r * wp.sin(angle), z)


_NUMBER = {name: number for number, name in enumerate(PARAMETERS)}

CAMERA_RANGE = wp.constant(_NUMBER["camera_range"])
BEARING_NOISE = wp.constant(_NUMBER["bearing_noise"])
ODOMETRY_NOISE = wp.constant(_NUMBER["odometry_noise"])
ODOMETRY_SCALE = wp.constant(_NUMBER["odometry_scale"])
GYRO_BIAS = wp.constant(_NUMBER["gyro_bias"])
SLIP_RATE = wp.constant(_NUMBER["slip"])
EXTRINSICS = wp.constant(_NUMBER["extrinsics"])
INITIAL_ERROR = wp.constant(_NUMBER["initial_error"])
LANDMARK_PRESENCE = wp.constant(_NUMBER["landmark_presence"])
V2X_LOSS = wp.constant(_NUMBER["v2x_loss"])
TRAFFIC_PACE = wp.constant(_NUMBER["traffic_pace"])
WANDER = wp.constant(_NUMBER["wander"])
"""Indices of the state's field `parameter`."""

NOT_SET = -1.0
"""Value in the state's field `parameter_set` for a drawn factor."""


@wp.func
def draw_parameters(model: Any, state: Any, world: int):
    """Draw the factors of a world that are not set."""
    level = state.difficulty[world]
    one = type(level)(1.0)
    for k in range(model.drawn.low.shape[0]):
        factor = state.parameter_set[world, k]
        if factor < type(level)(0.0):
            words = random_words(state.seed[world], state.episode[world], 0, k, PARAMETER)
            low = model.drawn.low[k]
            factor = low + (model.drawn.high[k] - low) * uniform(words[0], one)
            easy = model.drawn.easy[k]
            factor = factor * (easy + (model.drawn.hard[k] - easy) * level)
        state.parameter[world, k] = factor
