"""Least squares whose uncertainty holds where errors are correlated within blocks of time."""

from typing import NamedTuple

import numpy as np
from scipy import stats

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


def wald_test(
    matrix: np.ndarray,
    residual: np.ndarray,
    nuisance: np.ndarray,
    labels: np.ndarray,
    num_fitted: int | None = None,
) -> float:
    """Return the p-value of a robust test that all of the columns' coefficients are 0.

    One column that was fitted with several parameters is tested as that many: the statistic of the
    linear combination that explains most is that of all of them together (Scheffé 1953). What a fit
    changes is evidence only in the direction in which it does.

    Args:
        matrix: Columns, [M, k].
        residual: [M].
        nuisance: Orthonormal columns that are projected out first, [M, n].
        labels: The block of each residual, integers, [M].
        num_fitted: Number of parameters that were fitted to find the one column; None where nothing
            was.
    """
    unit = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    matrix, residual = (
        without(matrix / unit, nuisance),
        residual - nuisance @ (nuisance.T @ residual),
    )
    norm = np.linalg.norm(matrix, axis=0)
    matrix = matrix[:, norm > 1e-6]
    if matrix.shape[1] == 0:
        return 1.0
    found = regress(matrix, residual, labels)
    if num_fitted is not None and found.coefficient[0] <= 0:
        return 1.0
    num = num_fitted or matrix.shape[1]
    precision = np.linalg.pinv(found.covariance, hermitian=True)
    statistic = float(found.coefficient @ precision @ found.coefficient) / num
    freedom = max(found.freedom + matrix.shape[1] - num, 1)
    return float(stats.f.sf(statistic, num, freedom))


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of columns [M, k] without the directions that are zero."""
    scale = np.linalg.norm(columns, axis=0)
    columns = columns[:, scale > 0] / scale[scale > 0]
    if columns.shape[1] == 0:
        return columns
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, s > 1e-6 * s[0]]


def without(columns: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Return columns [M, k] less their parts along an orthonormal basis [M, n]."""
    return columns - basis @ (basis.T @ columns)
