"""Accuracy of positions: sample quantiles with their confidence intervals, moments."""

from dataclasses import dataclass

import numpy as np
from scipy.special import bdtr, gammaincinv

from amers.services.types import Array, IntArray

MIN_CHECK_POINTS = 30
"""Smallest number of check points by ASPRS (Positional Accuracy Standards, edition 2)."""

QUANTILE_PROBABILITY = 0.9
"""CE90 and LE90 hold 90 % of the errors."""
QUANTILE_CONFIDENCE = 0.9
"""Confidence of the intervals of CE90 and LE90."""
NORMALISED_CONFIDENCE = 0.95
"""Confidence of the interval of an honest normalised error."""


@dataclass(frozen=True)
class Quantile:
    """A quantile of a sample with a confidence interval that assumes no distribution.

    Attributes:
        value: estimate; NaN without a sample.
        lower, upper: bounds of the true quantile, order statistics of the sample; NaN where the sample
            is too small for a bound on that side.
        n: size of the sample.
        probability: which quantile, 0.9 for CE90 and LE90.
        confidence: smallest confidence of the interval.
        note: limits of a small sample, as a sentence; "" when there are none.
    """

    value: float
    lower: float
    upper: float
    n: int
    probability: float
    confidence: float
    note: str


@dataclass(frozen=True)
class Statistics:
    """Moments of the errors of one coordinate.

    Attributes:
        n: finite values.
        mean: NaN without values.
        std: about the mean, n - 1 in the denominator; NaN below two values.
        rms: about zero.
    """

    n: int
    mean: float
    std: float
    rms: float


@dataclass(frozen=True)
class Accuracy:
    """Errors of points against a better source.

    Attributes:
        n: points.
        bias_m, std_m, rmse_m: east, north and, when known, up.
        ce90_m: of the horizontal distance.
        le90_m: of the absolute height error; None when heights were not compared.
    """

    n: int
    bias_m: tuple[float, ...]
    std_m: tuple[float, ...]
    rmse_m: tuple[float, ...]
    ce90_m: Quantile
    le90_m: Quantile | None


@dataclass(frozen=True)
class NormalisedError:
    """Mean square of errors in units of their stated precision; 1 when the precision is honest.

    Attributes:
        mean_square: above 1, errors are larger than stated; below 1, smaller.
        lower, upper: interval of the mean square when the stated precision is honest.
        n: number of errors.
        confidence: of the interval.
    """

    mean_square: float
    lower: float
    upper: float
    n: int
    confidence: float


def statistics(values: Array) -> Statistics:
    """Mean, standard deviation and root mean square of the finite values of (n,) `values`."""
    finite = values[np.isfinite(values)]
    n = len(finite)
    if n == 0:
        return Statistics(0, np.nan, np.nan, np.nan)
    std = float(finite.std(ddof=1)) if n > 1 else float("nan")
    return Statistics(n, float(finite.mean()), std, float(np.sqrt(np.mean(finite**2))))


def sample_quantile(values: Array, effective: float | None = None) -> Quantile:
    """The 90 % quantile of a sample and its distribution-free confidence interval.

    The number of values below the true quantile is binomial for any distribution, so order statistics
    bound it (Dolloff and Carr, Computation of scalar accuracy metrics LE, CE and SE as both predictive
    and sample-based statistics, ASPRS 2016). Half of the risk is given to each side: at 90 % confidence
    the 90 % quantile has an upper bound from 29 values on. The estimate is the median-unbiased one
    (Hyndman and Fan, type 8): it assumes no distribution, and small samples give no optimistic value.

    Args:
        values: (n,) any order; values that are not finite are left out.
        effective: number of independent values that the sample is worth (`effective_number`); None for
            all of them.
    """
    probability, confidence = QUANTILE_PROBABILITY, QUANTILE_CONFIDENCE
    ordered = np.sort(values[np.isfinite(values)])
    n = len(ordered)
    if n == 0:
        return Quantile(np.nan, np.nan, np.nan, 0, probability, confidence, "no points")
    worth = n if effective is None else max(1, min(n, int(effective)))
    risk = (1.0 - confidence) / 2.0
    less_than = np.concatenate([[0.0], bdtr(np.arange(worth), worth, probability)])
    first = int(np.flatnonzero(less_than <= risk)[-1])
    enough = np.flatnonzero(1.0 - less_than <= risk)
    last = int(enough[0]) if len(enough) else 0

    def bound(rank: int) -> float:
        """The value of a rank among the independent values; NaN for rank 0."""
        share = rank / (worth + 1.0)
        return float(np.quantile(ordered, share, method="weibull")) if rank else float("nan")

    return Quantile(
        value=float(np.quantile(ordered, probability, method="median_unbiased")),
        lower=bound(first),
        upper=bound(last),
        n=n,
        probability=probability,
        confidence=confidence,
        note=_small_sample_note(n, worth, bounded=last > 0),
    )


def effective_number(error: Array, group: IntArray) -> float:
    """Number of independent errors that a sample is worth whose groups share a part of their errors.

    Kish (1965), Survey sampling: n over 1 + (m - 1) r, with the size m of the groups, mean weighted by
    the size, and the share r of the variance that lies between groups, by analysis of variance. With one
    group nothing shows r, and all n errors count.

    Args:
        error: (n, k).
        group: (n,) any numbers.
    """
    n = len(error)
    _, member, size = np.unique(group, return_inverse=True, return_counts=True)
    groups = len(size)
    if groups < 2 or n <= groups:
        return float(n)
    means = np.stack([np.bincount(member, column) / size for column in error.T], axis=1)
    within = float(((error - means[member]) ** 2).sum()) / (n - groups)
    between = float((size * ((means - error.mean(axis=0)) ** 2).sum(axis=1)).sum()) / (groups - 1)
    mean_size = float((size**2).sum()) / n
    shared = max(0.0, between - within) / ((n - mean_size) / (groups - 1))
    share = shared / max(shared + within, 1e-300)
    return n / (1.0 + (mean_size - 1.0) * share)


def _small_sample_note(n: int, worth: int, bounded: bool) -> str:
    """The limits of a sample of n values that are worth fewer independent ones, as a sentence."""
    points = f"{n} points" if worth == n else f"{n} points that share errors, worth {worth},"
    if worth >= MIN_CHECK_POINTS:
        return "" if bounded else f"{points} do not bound the quantile from above"
    note = f"{n} points" if worth == n else f"{n} points that share errors and are worth {worth}"
    note = f"{note}; {MIN_CHECK_POINTS} are needed for a statement of accuracy"
    return note if bounded else f"{note}; so few do not bound the quantile from above"


def accuracy(error_m: Array, group: IntArray | None = None) -> Accuracy:
    """Accuracy of points with known errors.

    Args:
        error_m: (n, 2) east, north or (n, 3) east, north, up; rows with a NaN are left out.
        group: (n,) any numbers: errors of one group share a part of theirs; None for independent ones.
    """
    finite = np.isfinite(error_m).all(axis=1)
    error_m = error_m[finite]

    def worth(columns: slice) -> float | None:
        return None if group is None else effective_number(error_m[:, columns], group[finite])

    axes = [statistics(column) for column in error_m.T]
    return Accuracy(
        n=len(error_m),
        bias_m=tuple(axis.mean for axis in axes),
        std_m=tuple(axis.std for axis in axes),
        rmse_m=tuple(axis.rms for axis in axes),
        ce90_m=sample_quantile(np.hypot(error_m[:, 0], error_m[:, 1]), worth(slice(2))),
        le90_m=sample_quantile(np.abs(error_m[:, 2]), worth(slice(2, 3)))
        if error_m.shape[1] > 2
        else None,
    )


def normalised_error(error: Array, covariance: Array) -> NormalisedError:
    """Mean square of errors in units of their covariances: near 1 when the covariances are honest.

    Args:
        error: (n, k); rows with a NaN, in the error or its covariance, are left out.
        covariance: (n, k, k) stated for them, same units squared.
    """
    confidence = NORMALISED_CONFIDENCE
    finite = np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    rows, k = int(finite.sum()), error.shape[1]
    if rows == 0:
        return NormalisedError(np.nan, np.nan, np.nan, 0, confidence)
    weighted = np.linalg.solve(covariance[finite], error[finite][:, :, None])[:, :, 0]
    freedom = rows * k
    tails = [(1.0 - confidence) / 2.0, (1.0 + confidence) / 2.0]
    lower, upper = 2.0 * gammaincinv(freedom / 2.0, tails) / freedom
    mean_square = float(np.sum(weighted * error[finite]) / freedom)
    return NormalisedError(mean_square, float(lower), float(upper), rows, confidence)
