"""Constants of the filter with their units; "Chosen" and "Tuned" mark those that do not follow from a model."""

THIRD = 1.0 / 3.0

# Belief

MAX_MEMBERS = 5  # vehicles in a belief, the vehicle itself included, calibration states excluded
MAX_LINEARISATIONS, RELINEARISATION_ANGLE = 8, 0.05
"""Linearisations of one correction; rad: largest turn of a line of sight without another linearisation. Tuned."""
LINEARISATION_TIME, MEMBER_LINEARISATION_TIME, CONSIDERED_LINEARISATION_TIME = 0.1, 1.0, 12.0
"""s for which the linearisation error of a bearing is correlated, so that all frames of that time count as one: for a
landmark, for a member, and for a considered member, whose error no later bearing corrects. Tuned."""
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
MIN_ERROR_STD = 1e-6  # rad/s, a share, rad and m: of a calibration state that is not declared beside one that is

# Tests

BEARING_GATE = 13.8  # gate of a bearing's normalised innovation squared: chi-square of 2, 0.999
MESSAGE_GATE = 40.0
"""Gate of the squared distance between a message and the belief about its sender: chi-square of 6, 1 - 5e-7."""
AGREEMENT_TIME, AGREEMENT_DISTANCE = 1.0, 1.0
"""s and m: how long and how closely an excluded sender must agree before it is readmitted. Chosen."""
AGREEMENT_GATE = 16.8  # of the squared distance at which an excluded sender agrees: chi-square of 6, 0.99
MAX_RETESTED_EXCLUSIONS = 2  # exclusions of a sender that may be retested. Chosen
MAX_EXCLUSIONS = 7  # after which the exclusion lasts 2^(n - 1) s, a minute. Chosen
SILENCE_TIME = 0.5  # s, after which a reported pose may jump: a lost sender broadcasts nothing. Chosen
RESET_GROWTH = 0.5  # growth of a sender's variance, as a share of it, that counts as a reset. Chosen
DRIFT_GATE, DRIFT_CLEAR = 28.0, 9.0
"""Gate of the squared size of a sender's drift from its odometry, chi-square of 3: 1 - 4e-6; and that of an excluded
sender, 0.97."""
DRIFT_STD = 6.0  # least drift for an exclusion, in reported standard deviations. Chosen
DRIFT_TIME, SLOW_DRIFT_TIME = 3.0, 30.0
"""s: time constants of the sums that compare a sender's position with its odometry. Chosen."""
SLACK = 0.1  # share of the odometry noise that a reported covariance may lack. Tuned
JUMP_STD = 4.0  # standard deviations beyond braking that count as a jump of its odometry
INNOVATION_SUM_GATE = 60.0
"""Gate of the squared size of a sender's error that innovations reveal. Tuned: correct senders pass."""
INNOVATION_SUM_SHARE = 0.5  # of a frame's information on that, because innovations are not quite white. Tuned
LEAST_INFORMATION = 0.01  # 1/m^2, at first
ERROR_FACTOR = 2.0  # ratio of the possible to the detected error of a faulty sender. Chosen
GROSS_ERROR, GROSS_TURN = 0.5, 0.1
"""m: error of a sender that invalidates linearisations; rad of the own pose per metre of that error. Tuned."""
LOST_SHARE, LOST_TIME = 0.6, 0.5
"""Share of bearings that contradict the belief, and the time over which it is averaged, s. Chosen: one wrong
association of two does not exceed it."""
HEALTHY_SHARE, HEALTHY_TIME = 0.2, 1.0
"""Share of contradicting bearings, and for how long, s, it must be lower for the pose to be an anchor. Chosen."""
ANCHOR_ANGLE_VARIANCE, ANCHOR_POSITION_VARIANCE = 0.05**2, 0.5**2
"""rad^2 and m^2, added to the covariance of an anchor, which may be wrong where the belief was lost. Chosen."""
LANDMARK_ONLY_PERIOD = 0.2  # s between corrections of the landmark-only solution. Chosen
LANDMARK_ONLY_NOISE = 4.0
"""Ratio of the variances of its bearings and odometry to those declared: with two landmarks in view, linearisation
makes the covariance of unobservable directions too small. Tuned."""
SEPARATION_GATE = 24.0  # of the squared distance between belief and landmark-only solution: chi-square of 6, 0.9995
DISPUTE_MARGIN = 6.0
"""Difference in cost by which another sender than the suspect is found faulty: odds of exp(-3)."""
RETEST_MARGIN = 12.0
"""Difference in cost by which another exclusion replaces the present ones: odds of exp(-6). Tuned: at 6 some vehicles
change their exclusions often, at 18 some are slow."""
ENOUGH_LANDMARKS = 2  # in view for which the landmark-only solution outweighs several senders. Chosen
NOT_AHEAD = 10.0  # rad, residual of a bearing whose target is behind the camera; it fails every gate
CONSISTENT_QUANTILE = 3.09  # of a normal distribution, 0.999: bound on the cost of consistent bearings

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
