"""Least squares whose uncertainty holds where errors are correlated within blocks of time."""

from typing import NamedTuple

import numpy as np

CONDITION = 1e-9
"""Eigenvalue of the normal matrix of unit columns, relative to the largest, that counts as zero."""


class Regression(NamedTuple):
    """A linear fit of residuals.

    Attributes:
        coefficient: By how much of each column the residual is lowered most, [k].
        covariance: Of the coefficients, [k, k].
        rest: What is left of the residual, [M].
        freedom: Degrees of freedom: blocks beyond the number of columns.
    """

    coefficient: np.ndarray
    covariance: np.ndarray
    rest: np.ndarray
    freedom: int


def regress(columns: np.ndarray, residual: np.ndarray, labels: np.ndarray) -> Regression:
    """Minimise |residual + columns @ coefficient|, with a cluster-robust covariance.

    The sandwich estimator of Liang and Zeger (1986), blocks being the clusters, with the usual
    factor B / (B - k) for a finite number B of them.

    Args:
        columns: [M, k]; one that is zero gets a coefficient and a variance of 0.
        residual: [M].
        labels: The block of each residual, integers, [M].
    """
    unit = np.linalg.norm(columns, axis=0)
    unit = np.where(unit > 0, unit, 1.0)
    columns = columns / unit
    bread = np.linalg.pinv(columns.T @ columns, rcond=CONDITION, hermitian=True)
    coefficient = -bread @ (columns.T @ residual)
    rest = residual + columns @ coefficient
    scores = np.stack([np.bincount(labels, column * rest) for column in columns.T], axis=1)
    num_blocks = len(np.unique(labels))
    freedom = max(num_blocks - len(unit), 1)
    covariance = bread @ (scores.T @ scores) @ bread * (num_blocks / freedom)
    return Regression(coefficient / unit, covariance / np.outer(unit, unit), rest, freedom)
