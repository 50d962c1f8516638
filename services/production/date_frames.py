"""Position of each date of ortho-images on the Earth, from the shifts between dates."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.imagery.archives import StatedAccuracy
from amers.services.types import Array, IntArray

MEASURED_SIGMA_M = 0.3
"""Error of a measured shift, metres: 0.03 of a pixel of 10 m, the floor of the matching."""


_LESS_ACCURATE = 10.0
"""Factor of the sigma of dates that are less accurate than the best."""


@dataclass(frozen=True)
class DateShifts:
    """Measured shifts between dates.

    Attributes:
        first, other: (m,) numbers of dates.
        shift_m: (m, 2) east, north, by which the other date lies off the first.
    """

    first: IntArray
    other: IntArray
    shift_m: Array


@dataclass(frozen=True)
class DateFrames:
    """Errors of dates on the Earth, and of their mean.

    Attributes:
        error_m: (n, 2) east, north, by which each date lies off the adjusted mean.
        sigma_m: what remains when the error is removed, a coordinate.
        stated_m: the same without the disagreement of the dates.
        factor: of the independent errors of dates over what is stated, 1 at least.
        apart_m: largest distance between two dates.
        orbits_apart_m: largest distance between the means of two orbits; 0 with one.
        orbits: number of orbits.
    """

    error_m: Array
    sigma_m: float
    stated_m: float
    factor: float
    apart_m: float
    orbits_apart_m: float
    orbits: int


def date_frames(
    stated: Sequence[StatedAccuracy], orbit: Sequence[str], shifts: DateShifts
) -> DateFrames:
    """The most probable error of every date, and the accuracy of the frame without it.

    Errors of dates are independent normal draws of `own_m`, to which the dates of one statement add one
    common draw. Least squares with these as prior: no shift shows the common draw, nor the mean of the
    own ones. Dates of a less accurate statement follow the others: what their errors share is not
    stated, and they count in the frame with a hundredth of their weight. Where shifts are larger than
    the own errors explain, these are scaled (Birge ratio). Where the means of orbits differ by more than
    their dates explain, the excess variance over the number of orbits is added (method of moments,
    DerSimonian and Laird 1986). No shift shows what all dates share: the frame is never stated better
    than the best date states itself, and with one orbit, or unknown ones, never better than its scaled
    dates.

    Args:
        stated: of the n dates.
        orbit: of the dates; "" where unknown.
        shifts: between dates.
    """
    own_m = np.array([one.own_m for one in stated])
    common_m = np.array([one.common_m for one in stated])
    groups = np.array([f"{one.own_m} {one.common_m}" for one in stated])
    shared = np.where(groups[:, None] == groups[None, :], common_m[:, None] * common_m[None, :], 0.0)
    design = np.zeros((len(shifts.first), len(own_m)))
    total_m = np.hypot(own_m, common_m)
    trust = np.where(total_m > 1.01 * total_m.min(), _LESS_ACCURATE, 1.0)
    rows = np.arange(len(design))
    design[rows, shifts.other] += 1.0
    design[rows, shifts.first] -= 1.0
    noise = MEASURED_SIGMA_M**2 * np.eye(len(design))

    def adjusted(factor: float) -> tuple[Array, float]:
        prior = np.diag((factor * trust * own_m) ** 2) + shared
        gain = prior @ design.T @ np.linalg.inv(design @ prior @ design.T + noise)
        left = prior - gain @ design @ prior
        return gain @ shifts.shift_m, float(np.sqrt(np.diag(left).max()))

    expected = design @ (np.diag(own_m**2) + shared) @ design.T + noise
    chi2 = float(np.sum(shifts.shift_m * np.linalg.solve(expected, shifts.shift_m)))
    factor = max(1.0, float(np.sqrt(chi2 / max(1, 2 * len(design)))))
    stated_m = max(adjusted(1.0)[1], float(total_m.min()))
    error_m, sigma_m = adjusted(factor)
    names = sorted(set(orbit) - {""})
    apart_m, excess_m2 = _orbits(error_m, orbit, factor * own_m)
    scale = factor if len(names) < 2 else 1.0
    sigma_m = max(sigma_m, float(np.hypot(scale * own_m, common_m).min()))
    distances = np.linalg.norm(error_m[:, None] - error_m[None, :], axis=2)
    return DateFrames(
        error_m=error_m,
        sigma_m=float(np.sqrt(sigma_m**2 + excess_m2 / max(1, len(names)))),
        stated_m=stated_m,
        factor=factor,
        apart_m=float(distances.max(initial=0.0)),
        orbits_apart_m=apart_m,
        orbits=len(names),
    )


def _orbits(error_m: Array, orbit: Sequence[str], own_m: Array) -> tuple[float, float]:
    """Largest distance between means of orbits, and their variance beyond that of their dates."""
    names = sorted(set(orbit) - {""})
    if len(names) < 2:
        return 0.0, 0.0
    rows = [np.array([one == name for one in orbit]) for name in names]
    weight = own_m**-2.0
    means = np.stack([np.average(error_m[row], axis=0, weights=weight[row]) for row in rows])
    explained = float(np.mean([1.0 / weight[row].sum() for row in rows]))
    found = float(((means - means.mean(axis=0)) ** 2).sum() / (2.0 * (len(names) - 1)))
    apart = np.linalg.norm(means[:, None] - means[None, :], axis=2)
    return float(apart.max()), max(0.0, found - explained)
