"""The measures of one point by several views, combined to one measure with its sigma."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.matching.correlate import FOUND, Peak, sigma_per_coordinate
from amers.services.matching.least_squares import covariance_from_influence
from amers.services.types import Array, BoolArray, IntArray


@dataclass(frozen=True)
class ViewCombination:
    """The measures of one point by several views, combined.

    Attributes:
        row_col: (2,) displacement, pixels of the reduced chips; NaN where the views give no measure.
        sigma_px: one standard deviation a coordinate without the scatter of views, same unit.
        excess_px2: sum of the squared distances of the views from the measure, less what their residuals
            explain.
        weight: (views,) of each view in the measure; 0 where it does not agree.
        reason: `FOUND`, or why there is no measure.
    """

    row_col: Array
    sigma_px: float
    excess_px2: float
    weight: Array
    reason: str

    @property
    def agreeing(self) -> BoolArray:
        """Which views (views,) the measure comes from."""
        return self.weight > 0.0


def combine_views(peaks: list[Peak], agreement_px: float) -> ViewCombination:
    """One measure from the peaks of the views of a point."""
    accepted = np.array([peak.reason == FOUND for peak in peaks])
    if not accepted.any():
        best = max(peaks, key=lambda peak: -1.0 if np.isnan(peak.score) else peak.score)
        return no_measure(len(peaks), best.reason)
    row_col = np.array([peak.row_col for peak in peaks])[accepted]
    near = np.hypot(*(row_col - np.median(row_col, axis=0)).T) <= agreement_px
    if 2 * near.sum() <= len(row_col) and len(row_col) > 1:
        return no_measure(len(peaks), "views_disagree")
    return _weighted_mean(peaks, np.flatnonzero(accepted)[near])


def no_measure(views: int, reason: str) -> ViewCombination:
    """The combination of views of which none gives a measure."""
    return ViewCombination(np.full(2, np.nan), np.nan, 0.0, np.zeros(views), reason)


def _weighted_mean(peaks: list[Peak], rows: IntArray) -> ViewCombination:
    """The weighted mean of the measures of one point by the views of some rows.

    The views of a point share the noise and the shadows of the scene. So their influences are averaged
    square by square, which keeps what they have in common. Their scatter beyond it is stated beside.
    """
    agreeing = [peaks[row] for row in rows]
    weight = np.array([peak.sigma_px for peak in agreeing]) ** -2.0
    weight /= weight.sum()
    row_col = np.array([peak.row_col for peak in agreeing])
    mean = weight @ row_col
    influences = np.stack([peak.influence for peak in agreeing])
    common = np.tensordot(weight, influences, axes=1)
    explained = sum(np.trace(covariance_from_influence(each - common)) for each in influences)
    all_weights = np.zeros(len(peaks))
    all_weights[rows] = weight
    return ViewCombination(
        mean,
        sigma_per_coordinate(covariance_from_influence(common)),
        float(((row_col - mean) ** 2).sum() - explained),
        all_weights,
        FOUND,
    )


def combined_sigmas_px(combinations: Sequence[ViewCombination]) -> Array:
    """One standard deviation a coordinate (n,) of the measures of n points; NaN where there is none.

    Views of a point scatter more than their residuals explain: each has an error of variance tau^2 of
    its own, which the mean keeps as tau^2 times the sum of the squared weights. Two to four views show
    little of it, a single view nothing: tau^2 is that of all points of the search together, by the
    method of moments. It is 0 where no point has two views.
    """
    weights = np.array([(c.weight**2).sum() for c in combinations])
    views = np.array([c.agreeing.sum() for c in combinations])
    # Expected sum of squared distances from a weighted mean, both coordinates, in units of tau^2.
    freedom = np.where(views > 1, 2.0 * (views - 2.0 + views * weights), 0.0)
    excess_px2 = sum(c.excess_px2 for c, count in zip(combinations, views, strict=True) if count > 1)
    tau_px2 = max(0.0, excess_px2 / freedom.sum()) if freedom.any() else 0.0
    return np.asarray(np.sqrt([c.sigma_px**2 for c in combinations] + tau_px2 * weights))
