"""Split covariance intersection of two covariances that may share errors."""

import numpy as np

WEIGHTS = 0.04 * np.arange(24, 0, -1)


def growth(own: float, gain: float, cost: float, theirs: float, noise: float, dependent: float) -> tuple[float, float]:
    """Return by what our and their covariance grow before they are fused, so that less is left (else 0, 0).

    Split covariance intersection: Li, Nashashibi, "Cooperative multi-vehicle localization using split covariance
    intersection filter", IEEE ITS Magazine 5(2), 2013; the weight is searched on a grid. `own` is h P h^T, `gain` are
    the weighted squares of P h^T, `cost` is the weighted trace of P, `theirs` and `noise` are variances of the bearing,
    `dependent` is the share of both covariances that may come from the same errors.
    """
    ours_by, theirs_by = 1 + dependent * (1 / WEIGHTS - 1), 1 + dependent * (1 / (1 - WEIGHTS) - 1)
    left = ours_by * cost - ours_by**2 * gain / (ours_by * own + noise + theirs * theirs_by)
    best = int(np.argmin(left))
    return (float(ours_by[best]), float(theirs_by[best])) if left[best] < cost else (0.0, 0.0)
