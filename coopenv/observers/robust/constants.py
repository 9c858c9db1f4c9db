"""Constants of the filter with their units; "Chosen" and "Tuned" mark constants that do not follow from a model."""

import math

import numpy as np
from scipy.special import chdtri

# Risk, numbers and times

RISK = 1e-3  # of a correct measurement outside its gate, and of an error above the protection level
BEARING_GATE, OFFSET_GATE, POSE_GATE = (float(chdtri(axes, RISK)) for axes in (2, 3, 6))
"""Gates of a normalised squared error: of a bearing, of a fault, and of a pose."""
ROUNDING = 1e-9  # share of its variances by which a covariance may fail to be positive definite
SINGLE = 8.0 * float(np.finfo(np.float32).eps)
"""Share of a variance that rounding to single precision in messages may change: eight roundings."""
MAX_CONDITION = 1.0 / SINGLE**2  # of the information of a frame; from there on it determines no pose
MIN_VARIANCE = 1e-14  # rad^2 and m^2, below which a covariance is malformed: 0.1 um
SAME_TIME = 1e-6  # s; times that differ by less differ by rounding only
SHORT_TIME, MEAN_TIME = 0.5, 1.0
LONG_TIME = 2.0 * MEAN_TIME
"""Times, s. Short: block of the monitors; silence after which a sender may restart; least tracking of a hypothesis.
Mean: window of recent means; duration of errors of calibration and of messages; time out of view after which sources
are evicted first. Long: least exclusion of a source; time for which most bearings may fail the gate before a restart,
and for which a search requires well determined solutions. Chosen."""

# Belief

MAX_MEMBERS = 5  # vehicles in a belief, the vehicle itself included, calibration states excluded
MAX_ITERATIONS = 8  # of one correction, and of the least squares from one frame. Chosen
LINEAR_ANGLE = 0.05
"""Largest turn (rad) of a line of sight without another linearisation, and largest standard deviation of a sender's
position, as an angle in view, for which its increments are applied. Tuned."""
NOTICEABLE_TURN = LINEAR_ANGLE**2
"""Turn (rad) of a line of sight by a correction from which on the measurements are linearised again: as large as the
second-order error of a turn that counts as linear."""
CONSIDERED_LINEARISATION_TIME = 12.0
"""Correlation time of the linearisation error of a bearing to another vehicle, s: no later bearing corrects it, and all
frames of that time count as one. Tuned."""
MAX_ACCELERATION = 1.0  # m/s^2 by which a member may leave its last known twist. Chosen: an ordinary start or stop
MAX_SMOOTH_ACCELERATION = 10.0 * MAX_ACCELERATION  # m/s^2 and rad/s^2: largest one by brakes and steering. Chosen
DISTANCE = 10.0  # m, of a typical target: in view, it moves as much by a turn of 0.1 rad as by a shift of 1 m
MIN_VELOCITY_STD = 2e-3
MIN_ANGULAR_VELOCITY_STD = MIN_VELOCITY_STD / DISTANCE
"""Least standard deviations of an odometry sample, m/s and rad/s: a moving vehicle's increments are never exact."""
JUMP_GATE = 2.0 * float(chdtri(3, RISK))  # of the squared change of a twist between samples, in sample variances
SHARE_OF_CHANGE = 0.2  # of a velocity, by which it must change before the effect of clock offsets is updated. Chosen
CALIBRATION_CHANGE = 0.02
"""Change of a calibration that is no fault: of the scale of a sender's odometry, as by tyres, and of the mounting in a
second, as a share of its declared deviation. Without turns, heading and mounting are not separately observable, and
linearisation makes both covariances slightly too small. Tuned."""
GYRO_BIAS, GYRO_BIAS_WALK = 1e-3, 1e-4
"""Least deviation of a gyro's bias (rad/s per axis) and of its walk (rad/s per root of a second), unless larger ones
are declared. The walk is tuned, from 2e-5 to 1e-3: the largest costs half of the accuracy without a fault."""

# Monitors

FAULT_GATE, FAULT_RISK = 35.0, 1e-2
"""Gate of twice the logarithm of a fault's likelihood ratio to no fault; probability that the excluded source
is correct. Tuned: in honest worlds the largest of all ratios was 34, with 30 % of the messages lost 48."""
ODDS = -2.0 * math.log(FAULT_RISK)  # difference of such ratios at which one hypothesis is nearly certain
MAX_EVIDENCE = 10.0 * BEARING_GATE
"""Limit of the normalised squared innovation of a rejected bearing: without it, random bearings to a target of which
some fail the gate are evidence of other faults; at 1, which of several sources is wrong shows too late. Tuned."""
MONITOR_TIME = 10.0  # s: time constant of the sums of a monitor. Chosen
OWN_FAULT = 0.1  # deviation of a fault of velocity and focal length, as a share, gyro, rad/s, and camera, rad. Chosen
LOST_SHARE, FOUND_SHARE = 0.6, 0.2
"""Share of bearings that fail the gate from which on it opens, and share below which it closes and the pose is an
anchor. Chosen: one wrong association of two does not exceed the first."""

# Messages

NEWS_TIME = 0.2
"""Period (s) of fusing a sender's reports; reports in between contribute their odometry alone. Also the time for
which all solutions of a search must be well determined, and the delay after a frame in which they are not. Chosen."""
LINEARISATION_TIME = 0.5 * NEWS_TIME  # correlation time, s, of the linearisation error of a bearing to a landmark
STEPS = int(np.iinfo(np.int8).max)  # of a correlation in a message, from 0 to 1
MAX_CORRELATIONS = 2  # in a message, which has 256 bytes then
VALID_TIME = MEAN_TIME + SAME_TIME
"""Longest time (s) between two reports for which the correlation of one is used for the other, and out of view for
which a member is not evicted. A correlation hardly changes in a second, and a missing one is worse."""
DISTINCT_VARIANCES = 1.44
"""Least ratio of two variances of a position that are not alike: deviations differ by a fifth. A sender's reset
multiplies its variance by more. From a sender that depends on this vehicle, or on an unknown correlation, bearings are
used if the own variance is larger by it: no circle of vehicles then confirms itself. Tuned: at 1 the order changes too
often, and at 2 many bearings are unused."""
LEAST_NEWS = 0.1
"""Share of a sender's variance that counts as noise of its increment: linearisation errors of small corrections add up.
Tuned."""
MASK_BITS = np.iinfo(np.uint64).bits  # vehicles in a mask; higher numbers share bits with lower ones

# Search

KNOWN_ANGLE = 0.2
KNOWN_POSITION = KNOWN_ANGLE * DISTANCE
"""Standard deviation per axis (rad and m) below which a pose is a linearisation point and is broadcast. Chosen."""
VAGUE_ANGLE = 5.0 * KNOWN_ANGLE  # standard deviation per axis, rad, above which an orientation is unknown. Chosen
MAX_HYPOTHESES = 6  # most hypotheses at once: P3P has four solutions at most, the prior is one more. Chosen
MARGIN = 2.0
"""Standard deviations by which measurements are perturbed to find solutions that noise removes; factor of a neighbour's
deviation in a frame that is solved, of a found pose's before it is broadcast, and of an anchor's. Chosen."""
SQUARED_MARGIN = MARGIN**2
PRUNE_GAP = BEARING_GATE + ODDS
"""Largest difference to the least cost: one wrong association, which costs `BEARING_GATE` at most, decides nothing."""
MAX_PRIOR_COST = 2.0 * PRUNE_GAP  # bound on the cost of the distance to the prior, which may be wrong
MAX_MISFIT = 5.0 * BEARING_GATE  # cost of the best hypothesis beyond twice the expected one: five wrong bearings
