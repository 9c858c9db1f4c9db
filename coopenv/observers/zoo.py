"""The observers of this package: one row each."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Entry:
    """Where an observer stands in this package; nothing is loaded before it is asked for."""

    plugin: str  # module and class, or function of a setup
    kernels: str = ""  # module and `Embedded`; empty: it runs on the host only
    needs: str = ""  # module of the extra `bench` without which it does not run
    in_space: bool = True  # whether it is meant for vehicles in space
    on_a_plane: bool = True
    """Whether it is meant for robots on a plane whose odometry is their commands (`Setup.planar`)."""
    kernels_on_a_plane: bool = True  # whether its kernels are those of the plug-in there
    covariance: bool = True  # whether its P is meant as a covariance, and is no matrix of gains


ZOO = {
    "dead_reckoning": Entry("dead_reckoning:DeadReckoning", "riccati.dead_reckoning:DEAD_RECKONING"),
    # on a plane bearings to three points say more than a pose needs
    "p3p": Entry("single_frame:PerspectivePoints", on_a_plane=False),
    "riccati": Entry("riccati.kernels:riccati", "riccati.kernels:RICCATI", covariance=False),
    "hamel_samson": Entry("hamel_samson:HamelSamson", covariance=False),
    "mekf": Entry("mekf:Mekf"),
    "mekf_covariance": Entry("mekf_covariance:MekfCovariance"),
    "mekf_covariance_ungated": Entry("mekf_covariance:MekfCovarianceUngated"),
    "covariance_intersection": Entry("covariance_intersection:CovarianceIntersection"),
    "split_covariance_intersection": Entry("split_covariance_intersection:SplitCovarianceIntersection"),
    "pairwise": Entry("pairwise:Pairwise"),
    "schmidt_kalman": Entry("schmidt_kalman:SchmidtKalman"),
    "iterated_ekf": Entry("iterated_ekf:IteratedEkf"),
    "left_invariant": Entry("left_invariant:LeftInvariant"),
    "right_invariant": Entry("right_invariant:RightInvariant"),
    "ukf": Entry("ukf:Ukf"),
    "factor_graph": Entry("factor_graph:FactorGraph", needs="gtsam"),
    "planar_ekf": Entry("planar.plugin:PlanarEkf", in_space=False),
    "planar_robust": Entry("planar.robust:PlanarRobust", in_space=False),
    "robust": Entry("robust.kernels:robust", "robust.kernels:ROBUST", on_a_plane=False, kernels_on_a_plane=False),
    "robust_joint": Entry(
        "robust.joint.kernels:robust_joint",
        "robust.joint.kernels:ROBUST_JOINT",
        on_a_plane=False,
        kernels_on_a_plane=False,
    ),
    "centralised": Entry("centralised:Centralised"),
}
"""By name."""
