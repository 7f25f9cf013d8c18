"""Least squares whose uncertainty holds where errors last, within blocks of time and beyond."""

from typing import NamedTuple

import numpy as np
from scipy import stats

CONDITION = 1e-9
"""Eigenvalue of the normal matrix of unit columns, relative to the largest, that counts as zero."""
LEAST_OF_OTHERS = 1e-3
"""Share of what is known of a coefficient that other blocks than one say, at least: one that says
all leaves nothing, and would change it by anything if it were left out."""


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
    return _regress(*directions(columns), residual, labels)[0]


def jackknife(
    columns: np.ndarray, residual: np.ndarray, labels: np.ndarray, stretches: np.ndarray
) -> Regression:
    """Do the same with the covariance that leaving each block out in turn tells.

    It holds where a few blocks say most of a coefficient, as those in which something slips: what
    the fit leaves of these is small since it goes through them, so that a sandwich looks certain
    (MacKinnon, Nielsen and Webb 2023). Errors that last for longer than a block, as a coarse
    encoder's at rest, widen it: standard deviations are at least those of Newey and West (1987),
    over 4 (B / 100)^(2/9) blocks (1994).

    Args:
        columns: As for `regress`.
        residual: [M].
        labels: The block of each residual, integers in the order of time, [M].
        stretches: The stretch in which the block with each label lies, by label: blocks of one
            follow each other.
    """
    basis, back = directions(columns)
    found, scores = _regress(basis, back, residual, labels)
    size = basis.shape[1]
    own = [_by_block(basis * direction[:, None], labels) for direction in basis.T]
    own = np.reshape(own, (size, len(scores), size)).swapaxes(0, 1)
    others, turn = np.linalg.eigh(np.eye(size) - own)
    turned = np.einsum("bij,bi->bj", turn, scores) / np.maximum(others, LEAST_OF_OTHERS)
    change = np.einsum("bij,bj->bi", turn, turned) @ back.T
    covariance = change.T @ change * (1.0 - 1.0 / len(np.unique(labels)))
    wider = _lasting(change, stretches[: len(change)], len(np.unique(labels)))
    return found._replace(covariance=covariance * np.outer(wider, wider))


def _regress(
    basis: np.ndarray, back: np.ndarray, residual: np.ndarray, labels: np.ndarray
) -> tuple[Regression, np.ndarray]:
    """Regress on orthonormal directions; return its sums over blocks, [labels, r], too.

    Args:
        basis: The directions, [M, r].
        back: Their part in coefficients, [k, r].
        residual: [M].
        labels: As for `regress`.
    """
    along = basis.T @ residual
    rest = residual - basis @ along
    num_blocks = len(np.unique(labels))
    freedom = max(num_blocks - len(back), 1)
    scores = _by_block(basis * rest[:, None], labels)
    of_each = scores @ back.T
    covariance = of_each.T @ of_each * (num_blocks / freedom)
    return Regression(-back @ along, covariance, rest, freedom), scores


def directions(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return orthonormal directions of columns [M, r], and their part in coefficients, [k, r]."""
    unit = np.linalg.norm(columns, axis=0)
    unit = np.where(unit > 0, unit, 1.0)
    columns = columns / unit
    square, ways = np.linalg.eigh(columns.T @ columns)
    is_told = square > CONDITION * square.max(initial=0.0)
    ways = ways[:, is_told] / np.sqrt(square[is_told])
    return columns @ ways, ways / unit[:, None]


def _by_block(values: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Sum values [M, r] over blocks, [labels, r]."""
    num = int(labels.max(initial=-1)) + 1
    sums = [np.bincount(labels, column, num) for column in values.T]
    return np.stack(sums, axis=1) if sums else np.zeros((num, 0))


def _lasting(change: np.ndarray, stretches: np.ndarray, num_blocks: int) -> np.ndarray:
    """Return by how much errors that last widen standard deviations, [k], 1 at least.

    Args:
        change: By how much leaving each block out changes the coefficients, [labels, k].
        stretches: The stretch that each lies in, [labels].
        num_blocks: How many there are residuals of.
    """
    alone = np.sum(change**2, axis=0)
    variance, lag = alone.copy(), int(4.0 * (num_blocks / 100.0) ** (2.0 / 9.0))
    for apart in range(1, min(lag, len(change) - 1) + 1):
        is_same = (stretches[apart:] == stretches[:-apart])[:, None]
        common = np.sum(change[apart:] * change[:-apart] * is_same, axis=0)
        variance += 2.0 * (1.0 - apart / (lag + 1.0)) * common
    return np.sqrt(np.maximum(variance / np.maximum(alone, 1e-300), 1.0))


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
