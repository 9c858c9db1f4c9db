"""Every number that is a choice, and why it is what it is."""

THIRD = 1.0 / 3.0

# Belief

MAX_MEMBERS, MAX_MEMBERS_JOINT = 5, 8
"""Vehicles in a belief, the vehicle itself included, what stands for its odometry's errors not: of `robust` and of
`robust_joint`."""
MAX_LINEARISATIONS, RELINEARISATION_ANGLE = 8, 0.05
"""Linearisations of one correction; how far it may turn a line of sight to be near, rad. Tuned."""
LINEARISATION_TIME, MEMBER_LINEARISATION_TIME, CONSIDERED_LINEARISATION_TIME = 0.1, 1.0, 12.0
"""s for which what a bearing's linearisation leaves out is the same, so that all frames of that time count as one: to a
landmark; to a member; and to one that is only considered, so that no later bearing repairs it. Tuned."""
SAME_TIME = 1e-6  # s; times that differ by less differ by rounding only
FORGET_TIME = 1.0  # s out of view after which a member may be evicted. Chosen
MAX_ACCELERATION = 1.0  # m/s^2 by which a member may leave its last known twist. Chosen: an ordinary start or stop
MIN_VELOCITY_STD, MIN_ANGULAR_VELOCITY_STD = 2e-3, 2e-4
"""m/s and rad/s, of an odometry sample: the increments of a moving vehicle are never exact."""

JUMP_GATE = 32.5
"""Change of the odometry's twist from sample to sample, squared, in variances of a sample, that is no noise: twice the
0.999 quantile of a chi-square of 3."""
MAX_SMOOTH_ACCELERATION, MAX_SMOOTH_ANGULAR_ACCELERATION = 10.0, 30.0
"""m/s^2 and rad/s^2 beyond which a change is one that no brakes and no steering make. Chosen."""

VELOCITY_TIME = 1.0
"""s over which the velocity is averaged by which a scale error counts. Chosen: little noise is left, and little lag."""
ERRORS_TIME = 1.0
"""s for which an error of a vehicle's odometry that lasts counts as the same where it is taken as noise. Chosen."""
SHARE_OF_CHANGE, LEAST_CHANGE = 0.2, 0.05
"""Share and m/s by which a velocity must change to count anew in what clocks that are off cost. Chosen."""
MIN_MOUNTING_STD = 1e-6  # rad and m, of an error of the mounting that is not declared beside one that is
MOUNTING_WALK = 0.02
"""Share of its declared deviation by which the mounting walks in a second: while a car hardly turns, bearings do not
tell its turn from that of the camera, and linearisations make a filter a little too sure of both. Tuned."""
MIN_ERROR_STD = 1e-6  # rad/s and a share: of an error that is not declared beside one that is

# Tests

BEARING_GATE = 13.8  # gate of a bearing's normalised innovation squared: chi-square of 2, 0.999
MESSAGE_GATE = 40.0
"""Gate of the squared distance between a message and the belief about its sender: chi-square of 6, 1 - 5e-7."""
AGREEMENT_TIME, AGREEMENT_DISTANCE = 1.0, 1.0
"""s and m: how long and how closely a distrusted sender must agree before it is trusted again. Chosen."""
AGREEMENT_GATE = 16.8  # of the squared distance at which a distrusted sender agrees: chi-square of 6, 0.99
MAX_RETESTED_EXCLUSIONS = (
    2  # how often a sender that is not believed may be believed again because others explain less. Chosen
)
MAX_EXCLUSIONS = 7  # from which on a sender is not believed for a minute: 2^(n - 1) s. Chosen
SILENCE_TIME = 0.5  # s, after which a sender may be elsewhere: who is lost says nothing. Chosen
RESET_GROWTH = 0.5  # by how much of its variance a sender must know less than before to admit an error. Chosen
DRIFT_GATE, DRIFT_CLEAR = 28.0, 9.0
"""Gate of the squared size of a sender's drift from its odometry, chi-square of 3: 1 - 4e-6; and below which a
distrusted one is clear of it, 0.97."""
DRIFT_STD = 6.0  # of what it says of itself, by which a sender must have drifted to be believed no more. Chosen
DRIFT_TIME, SLOW_DRIFT_TIME = 3.0, 30.0  # s over which a sender's place is held against its odometry. Chosen
SLACK = 0.1  # share of the noise of its odometry by which a sender may be off in what it says of its errors. Tuned
JUMP_STD = 4.0  # standard deviations beyond what brakes can do by which its odometry jumps
INNOVATION_SUM_GATE = 60.0
"""Gate of the squared size of a sender's error that innovations reveal. Tuned: honest senders pass."""
INNOVATION_SUM_SHARE = 0.5  # of a frame's information on that, because innovations are not quite white. Tuned
LEAST_INFORMATION = 0.01  # 1/m^2, at first
ERROR_FACTOR = 2.0  # by which who has lied may be farther off than it seems. Chosen
GROSS_ERROR, GROSS_TURN = 0.5, 0.1
"""m of which an error of a sender has spoilt linearisations, and rad of the own pose per metre of it. Tuned."""
LOST_SHARE, LOST_TIME = 0.6, 0.5
"""Share of bearings that contradict the belief, and the time over which it is averaged, s. Chosen: one wrong target of
two is not enough."""
HEALTHY_SHARE, HEALTHY_TIME = 0.2, 1.0
"""Share of contradicting bearings, and for how long, s, it must be lower for the pose to be an anchor. Chosen."""
ANCHOR_ANGLE_VARIANCE, ANCHOR_POSITION_VARIANCE = 0.05**2, 0.5**2
"""rad^2 and m^2, added to the covariance of an anchor, which may be wrong where the belief was lost. Chosen."""
LANDMARK_ONLY_PERIOD = 0.2  # s between corrections of what landmarks alone say. Chosen
LANDMARK_ONLY_NOISE = 4.0
"""Ratio of the variances of its bearings and odometry to those declared: with two landmarks in view, linearisations
make a filter sure of what it cannot know. Tuned."""
SEPARATION_GATE = 24.0  # of the squared distance of the belief from that: chi-square of 6, 0.9995
DISPUTE_MARGIN = 6.0
"""By how much less bearings to the others must cost without a sender for it to be wrong, and not the one that bearings
contradict: odds of exp(-3)."""
RETEST_MARGIN = 12.0
"""By how much less bearings must cost without another sender than without those that are not believed, for these to be
believed again: odds of exp(-6). Tuned: at 6 some vehicles change their minds often, at 18 some take long."""
ENOUGH_LANDMARKS = 2  # in view, for what they say alone to outweigh several senders. Chosen
NOT_AHEAD = 10.0  # rad, in place of the residual of a bearing whose target is behind the camera. It fits nothing
CONSISTENT_QUANTILE = 3.09  # of a normal distribution, 0.999: what bearings may cost that agree

# Messages

NEWS_TIME = 0.2
"""s between messages of a sender of which the news are fused; of those in between its odometry counts. Chosen."""
DEPENDENT_SHARE = 0.7
"""Share that counts of the information of a sender that depends on others: some may have arrived already. Tuned."""
STEPS = 127  # of a correlation, as it is sent
MAX_CORRELATIONS = 2  # in a message, which has 256 bytes then
CORRELATION_VALIDITY = 1.037
"""s between two reports of a vehicle for which what is told of one counts for the other: the correlation hardly changes
within a second, and not to know it is worse. No multiple of usual frame periods. Chosen."""
RETURNING_SHARE = 0.7
"""Ratio of the variance of a sender's position to that of one's own, above which bearings to it do not count if it
depends on this vehicle, or is met again: then no circle of vehicles confirms itself. Tuned: at 1 they change places too
often, and at 0.5 much is left unused."""
LEAST_NEWS = 0.1
"""Share of a sender's variance that counts as noise of the step by which it moves at its next message: what it has
learnt in small steps it has learnt by linearisations, which add up. Tuned."""
STEP_GATE = 22.5
"""Gate of the squared size of such a step in standard deviations: chi-square of 6, 0.999."""
MAX_SENDER_ANGLE = 0.01
"""rad, by how much a standard deviation of a sender's position may turn the line of sight to it for its steps to be
followed: larger ones are no small errors. Tuned."""
RELATIVE_NOISE = 1e-6  # share of a variance, that regressions have as noise
MIN_INFLATION = 0.005
"""Share of its covariance that is added to that of a sender which depends on others. What is told of correlations is
not all there is, so that everybody is a little too sure, and who hears him more so. Tuned."""
LEAST_LEFT = 0.003
"""Share of a sender's variance, in all directions, that neither its past nor what is told of others explains. Tuned."""
MAX_VARIANCE_GROWTH = 1.01
"""Ratio of a variance to the predicted one; beyond it the sender has lost information, and its message has no news."""
MAX_GROWTH = 2.0  # of a variance by information that is negative by rounding; it is below 1.1 as a rule
MASK_BITS = 64  # vehicles in a mask; numbers from 64 on share bits with lower ones
MAX_BROADCAST = 4  # vehicles in a message of `robust_joint`, the sender included: 1.7 kB
SUPERSEDING_TIME = 1.0  # s, for which a joint message stands for the messages of the vehicles that it holds. Chosen

ROUNDING = 1e-9  # share of its variances by which a covariance may fail to be positive definite
MIN_VARIANCE = 1e-14  # rad^2 and m^2, below which a message is malformed: nobody knows a pose to 0.1 um

# Search

KNOWN_ANGLE, KNOWN_POSITION = 0.2, 2.0
"""rad and m, standard deviation per axis below which a pose is linearised about and sent. Chosen."""
MAX_HYPOTHESES = 6  # most hypotheses at once: P3P has four solutions at most, the prior is one more. Chosen
PERTURBATION = 2.0  # standard deviations by which measurements are moved to find solutions that noise may hide
PROBLEMS = 1 + 3 * 2 * 5
"""Problems of three bearings: as measured; each moved to either side along two axes across it, and its point along
three."""
MAX_BEARING_COST = 16.0
"""Most that one bearing costs (chi-square of 2, 1 - 3e-4): below `PRUNE_GAP`, so that one wrong association decides
nothing."""
MAX_PRIOR_COST = 50.0  # most that being far from the prior costs: that may be wrong altogether
PRUNE_GAP = 20.0  # by how much the cost may exceed the least one: odds of exp(-10)
MAX_MISFIT = 80.0
"""Most that the best may cost beyond twice what is expected of a true one: five wrong bearings."""
CLEAR_TIME, PATIENCE = 0.25, 2.0
"""s, for which all solutions must have been well determined, and after which that is asked no more. Tuned."""
DOUBT_TIME = 0.1
"""s from a frame that has not told the pose well enough to the next look: what has to change is the vehicle's
place, or what its neighbours know. Chosen."""
MIN_SEARCH_TIME, MIN_DOUBTFUL_TIME = 0.5, 3.0
"""s, before a hypothesis becomes the belief; where a solution was not well determined. Tuned."""
SURE = 3.5
"""Times smaller than to tell others the variances of a pose that is found must be. Tuned."""
MAX_SPEED = 1.0  # m/s at which a sender may have gone on since a message that is used in the search. Chosen
CORRELATION_FACTOR, CORRELATION_TIME = 4.0, 1.0
"""Factor of a neighbour's variance in a frame that is solved; s for which its error is the same while hypotheses are
followed, so that all frames of that time count as one. Tuned."""
SAME_HYPOTHESIS, SAME_PRIOR = 16.0, 30.0
"""Squared distance, in standard deviations, below which two hypotheses are one (chi-square of 6, 0.986), and one is the
prior (1 - 4e-5)."""
GAUSS_NEWTON_STEPS = 6  # steps of the least squares from one frame. Chosen
MAX_CONDITION = 1e12
"""Of the information of a frame, as `is_regular` bounds it; from there on the frame determines no pose. Chosen."""
