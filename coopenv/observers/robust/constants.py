"""Constants of the filter with their units; "Chosen" and "Tuned" mark those that do not follow from a model."""

THIRD = 1.0 / 3.0
MEAN_TIME = 1.0

# Belief

MAX_MEMBERS = 5  # vehicles in a belief, the vehicle itself included, calibration states excluded
MAX_LINEARISATIONS, RELINEARISATION_ANGLE = 8, 0.05
"""Linearisations of one correction; rad: largest turn of a line of sight without another linearisation. Tuned."""
LINEARISATION_TIME, CONSIDERED_LINEARISATION_TIME = 0.1, 12.0
"""s for which the linearisation error of a bearing is correlated, so that all frames of that time count as one: for a
landmark, and for another vehicle, whose error no later bearing corrects. Tuned."""
SAME_TIME = 1e-6  # s; times that differ by less differ by rounding only
FORGET_TIME = 1.0  # s out of view after which a member may be evicted. Chosen
MAX_ACCELERATION = 1.0  # m/s^2 by which a member may leave its last known twist. Chosen: an ordinary start or stop
MIN_VELOCITY_STD, MIN_ANGULAR_VELOCITY_STD = 2e-3, 2e-4
"""m/s and rad/s, of an odometry sample: the increments of a moving vehicle are never exact."""

JUMP_GATE = 32.5
"""Gate of the squared change of the odometry's twist between samples, in sample variances: twice the 0.999 quantile of
a chi-square of 3."""
MAX_SMOOTH_ACCELERATION, MAX_SMOOTH_ANGULAR_ACCELERATION = 10.0, 30.0
"""m/s^2 and rad/s^2: largest accelerations by brakes and steering. Chosen."""

VELOCITY_TIME = 1.0
"""s over which the velocity in the scale error's derivative is averaged. Chosen: small noise and small lag."""
ERRORS_TIME = 1.0
"""s for which a lasting odometry error is correlated where it counts as noise. Chosen."""
SHARE_OF_CHANGE, LEAST_CHANGE = 0.2, 0.05
"""Share and m/s by which a velocity must change before the effect of clock offsets is updated. Chosen."""
MOUNTING_WALK = 0.02
"""Share of its declared deviation by which the mounting walks in a second. Without turns, heading and mounting
are not separately observable, and linearisation makes both covariances slightly too small. Tuned."""
GYRO_BIAS, GYRO_BIAS_WALK = 2e-3, 1e-3
"""rad/s per axis, and rad/s in the root of a second: least deviation of a gyro's bias and of its walk, where no larger
ones are declared. In proportion to the noise of a sample they cost accuracy where the gyro is noisy. Chosen."""
MIN_ERROR_STD = 1e-6  # rad/s, a share, rad and m: of a calibration state that is not declared beside one that is

# Monitors

BEARING_GATE = 13.8  # gate of a bearing's normalised innovation squared: chi-square of 2, 0.999
SILENCE_TIME = 0.5  # s, after which a reported pose may jump: a lost sender broadcasts nothing. Chosen
RESET_GROWTH = 0.5  # growth of a sender's variance, as a share of it, that counts as a reset. Chosen
FAULT_GATE, FAULT_RISK = 30.0, 1e-2
"""Ratio, twice its logarithm, from which the fault of a source is likelier than none; probability that the source that
is excluded is right. Tuned: in honest worlds the largest of all ratios was 34."""
PROTECTION_RISK = 1e-3  # of an error above the protection level
ODOMETRY_FAULT = 0.1  # standard deviation of the fault of the odometry's velocity, as a share of the speed. Chosen
MONITOR_TIME, BLOCK_TIME = 10.0, 0.5
"""s: time constant of the sums of a monitor, and time between two looks at them. Chosen."""
READMISSION_TIME, MAX_DOUBLINGS = 2.0, 5
"""s for which a source stays excluded at first, and how often that time is doubled for a source that is excluded again,
to a minute. Chosen."""
LOST_SHARE, FOUND_SHARE, LOST_TIME, OPEN_TIME = 0.6, 0.1, 1.0, 5.0
"""Share of bearings that fail the gate from which on all bearings count, share below which the gate is closed again,
time over which the share is averaged, and time after which a search begins, s. Chosen: one wrong association of two
does not exceed the share."""
HEALTHY_SHARE, HEALTHY_TIME = 0.2, 1.0
"""Share of contradicting bearings, and for how long, s, it must be lower for the pose to be an anchor. Chosen."""
ANCHOR_ANGLE_VARIANCE, ANCHOR_POSITION_VARIANCE = 0.05**2, 0.5**2
"""rad^2 and m^2, added to the covariance of an anchor, which may be wrong where the belief was lost. Chosen."""

# Messages

NEWS_TIME = 0.2
"""s between the reports of a sender that are fused; of those in between only the odometry is used. Chosen."""
STEPS = 127  # of a correlation in a message, from 0 to 1
MAX_CORRELATIONS = 2  # in a message, which has 256 bytes then
CORRELATION_VALIDITY = 1.037
"""s between two reports of a vehicle within which the correlation of one is used for the other. It hardly changes in a
second, and a missing correlation is worse. No multiple of usual frame periods. Chosen."""
RETURNING_SHARE = 0.7
"""Ratio of the variances of the sender's and the own position above which bearings to a sender are not used, if the
sender depends on this vehicle or on an unknown correlation. No circle of vehicles then confirms itself. Tuned: at 1 the
order changes too often, and at 0.5 many bearings are unused."""
LEAST_NEWS = 0.1
"""Share of a sender's variance that counts as noise of its increment: linearisation errors of small corrections add up.
Tuned."""
LEAST_STEP = 0.003  # share of a sender's variance that its monitor adds to that of a step. Chosen: small
STEP_GATE = 22.5
"""Gate of the squared size of such an increment in standard deviations: chi-square of 6, 0.999."""
MAX_SENDER_ANGLE = 0.01
"""rad: largest standard deviation of a sender's position, as an angle in view, for which its increments are applied;
larger errors are not linear. Tuned."""
RELATIVE_NOISE = 1e-6  # share of a variance that is added as noise in regressions
MIN_INFLATION = 0.005
"""Share by which the covariance of a sender that depends on other vehicles is inflated. Messages hold only some of the
correlations, so that covariances are slightly too small, more so with every receiver in a chain. Tuned."""
LEAST_LEFT = 0.003
"""Least share of a sender's variance, in all directions, that known correlations do not explain. Tuned."""
MASK_BITS = 64  # vehicles in a mask; numbers from 64 on share bits with lower ones

ROUNDING = 1e-9  # share of its variances by which a covariance may fail to be positive definite
MIN_VARIANCE = 1e-14  # rad^2 and m^2, below which a message is malformed: 0.1 um

# Search

KNOWN_ANGLE, KNOWN_POSITION = 0.2, 2.0
"""rad and m: standard deviation per axis below which a pose is a linearisation point and is sent. Chosen."""
MAX_HYPOTHESES = 6  # most hypotheses at once: P3P has four solutions at most, the prior is one more. Chosen
PERTURBATION = 2.0  # standard deviations by which measurements are perturbed to find solutions that noise removes
PROBLEMS = 1 + 3 * 2 * 5
"""Problems of three bearings: as measured; each moved to either side along two axes across it, and its point along
three."""
MAX_BEARING_COST = 16.0
"""Most that one bearing costs (chi-square of 2, 1 - 3e-4): below `PRUNE_GAP`, so that one wrong association does
not decide."""
MAX_PRIOR_COST = 50.0  # bound on the cost of the distance to the prior, which may be wrong
PRUNE_GAP = 20.0  # largest difference to the least cost: odds of exp(-10)
MAX_MISFIT = 80.0
"""Largest cost of the best hypothesis beyond twice the expected one: five wrong bearings."""
CLEAR_TIME, PATIENCE = 0.25, 2.0
"""s: time for which all solutions must be well determined, and time after which this is not required. Tuned."""
DOUBT_TIME = 0.1
"""s from a frame that does not determine the pose to the next attempt: the position of the vehicle or the estimates of
its neighbours have to change. Chosen."""
MIN_SEARCH_TIME, MIN_DOUBTFUL_TIME = 0.5, 3.0
"""s before a hypothesis becomes the belief; the second if a solution was not well determined. Tuned."""
SURE = 3.5
"""Factor by which the variances of a found pose must be below those of a broadcast one. Tuned."""
MAX_SPEED = 1.0  # m/s: possible speed of a sender since a message that is used in the search. Chosen
CORRELATION_FACTOR, CORRELATION_TIME = 4.0, 1.0
"""Factor of a neighbour's variance in a frame that is solved; s for which its error is the same while hypotheses are
followed, so that all frames of that time count as one. Tuned."""
SAME_HYPOTHESIS, SAME_PRIOR = 16.0, 30.0
"""Squared distance, in standard deviations, below which two hypotheses are one (chi-square of 6, 0.986), and one is the
prior (1 - 4e-5)."""
GAUSS_NEWTON_STEPS = 6  # steps of the least squares from one frame. Chosen
MAX_CONDITION = 1e12
"""Of the information of a frame, as `is_regular` bounds it; from there on the frame determines no pose. Chosen."""
