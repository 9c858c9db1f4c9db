"""The observers of this package: one row each."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Entry:
    """Where an observer stands in this package; nothing is loaded before it is asked for."""

    plugin: str  # module and class, or function of a setup
    about: str  # one line for tables
    kernels: str = ""  # module and `Embedded`; empty: it runs on the host only
    needs: str = ""  # module of the extra `bench` without which it does not run
    in_space: bool = True  # whether it is meant for vehicles in space
    on_a_plane: bool = True
    """Whether it is meant for robots on a plane whose odometry is their commands (`Setup.planar`)."""
    kernels_on_a_plane: bool = True  # whether its kernels are those of the plug-in there
    covariance: bool = True  # whether its P is meant as a covariance, and is no matrix of gains


ZOO = {
    "dead_reckoning": Entry(
        "single_frame:DeadReckoning", "Adds up odometry and sends nothing", "riccati.dead_reckoning:DEAD_RECKONING"
    ),
    # on a plane bearings to three points say more than a pose needs
    "p3p": Entry("single_frame:PerspectivePoints", "A pose per frame from three bearings, no memory", on_a_plane=False),
    "riccati": Entry(
        "riccati.kernels:riccati",
        "The paper's observer, with the scenario's gains",
        "riccati.kernels:RICCATI",
        covariance=False,
    ),
    "hamel_samson": Entry(
        "error_state_filters:HamelSamson", "The paper's observer with landmarks alone", covariance=False
    ),
    "mekf": Entry("error_state_filters:Mekf", "Error-state filter; takes received positions as exact"),
    "mekf_covariance": Entry(
        "error_state_filters:MekfCovariance", "Error-state filter; weighs received positions by covariance"
    ),
    "mekf_covariance_ungated": Entry(
        "error_state_filters:MekfCovarianceUngated", "Error-state filter that accepts every bearing"
    ),
    "covariance_intersection": Entry(
        "covariance_intersection:CovarianceIntersection", "Kalman filter; neighbours by covariance intersection"
    ),
    "split_covariance_intersection": Entry(
        "covariance_intersection:SplitCovarianceIntersection", "Kalman filter; neighbours by split intersection"
    ),
    "pairwise": Entry("schmidt_kalman:Pairwise", "Keeps cross-covariances pair by pair"),
    "schmidt_kalman": Entry("schmidt_kalman:SchmidtKalman", "Considers neighbours with cross-covariances"),
    "iterated_ekf": Entry(
        "error_state_filters:IteratedEkf", "Error-state filter that iterates corrections; sends covariances"
    ),
    "left_invariant": Entry("error_state_filters:LeftInvariant", "Invariant filter, left error; sends covariances"),
    "right_invariant": Entry("error_state_filters:RightInvariant", "Invariant filter, right error; sends covariances"),
    "ukf": Entry("error_state_filters:Ukf", "Unscented (sigma-point) filter; sends covariances"),
    "factor_graph": Entry(
        "factor_graph:FactorGraph", "Factor graph smoothed at key frames; sends covariances", needs="gtsam"
    ),
    "planar_ekf": Entry("planar.plugin:PlanarEkf", "Extended Kalman filter of x, y and heading", in_space=False),
    "planar_robust": Entry(
        "planar.robust:PlanarRobust",
        "Calibrates its odometry online; fuses neighbours by split covariance intersection",
        in_space=False,
    ),
    "robust": Entry(
        "robust.observer:robust",
        "This project's observer for vehicles in space: several hypotheses, gates",
        "robust.observer:ROBUST",
        on_a_plane=False,
        kernels_on_a_plane=False,
    ),
    "robust_joint": Entry(
        "robust.joint_fusion:robust_joint",
        "The robust observer with larger, joint messages, for vehicles in space",
        "robust.joint_fusion:ROBUST_JOINT",
        on_a_plane=False,
        kernels_on_a_plane=False,
    ),
    "centralised": Entry("centralised:Centralised", "One filter over all vehicles and all measurements"),
}
"""By name."""
