"""Common errors of the points of a scene, which more points do not average out.

Three kinds are told from the residuals of a scene:

* every block has an offset of its own;
* neighbours have errors in common, correlated over a length;
* chips that overlap in the scene share its noise.

A residual shows little of what all its neighbours share, and few residuals show little at all.
Therefore no single answer is believed: covariances are averaged over how likely each is.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.distance import cdist
from scipy.special import ndtr

from amers.services.misfit.affine_fit import AffineFit, inverse_normal
from amers.services.misfit.robust import MAD_TO_STD
from amers.services.types import Array, BoolArray

_LENGTHS = np.array([0.05, 0.1, 0.2])
"""Correlation lengths that are considered, sides of the image."""
_SHARES = np.array([0.4, 0.65, 0.9])
"""Shares of the variance that are considered to be correlated."""
_MIDDLE = 5
"""Of the cases: the middle share over the middle length."""
_INDEPENDENT = 0.35
"""A priori probability that the errors are independent; the other cases share the rest."""
_UNCLEAR = 0.2
"""Probability that the errors are independent from which on nothing is clearly correlated."""
_STATED_IS_TRUE = 0.3
"""A priori probability that the stated sigmas are true, rather than off by a factor of up to ten."""
_CLIP = 2.2
"""Standard deviations from what its neighbours predict, beyond which a measure is drawn towards them."""
_CLIPPED_VARIANCE = float(
    1.0
    - 2.0 * (_CLIP * np.exp(-0.5 * _CLIP**2) / np.sqrt(2.0 * np.pi) + (1.0 - _CLIP**2) * ndtr(-_CLIP))
)
"""Variance of a normal law of unit variance when values beyond the clip are set to it."""
_ENOUGH = 250
"""Number of measures from which share and length are estimated; more are slower and no more precise."""
_UNKNOWN_OFFSET_PX = 1.0
"""A priori standard deviation of the offset of a block whose frame is not stated."""


@dataclass(frozen=True)
class SharedErrors:
    """What residuals tell of the variance of measures, in units of their stated variances.

    Attributes:
        factor: variance, at least 1.
        correlated: (l,) the part of it that is correlated over each of the lengths, mean of the cases.
        clear_share: that is correlated, mean of the cases, as far as it is clear that one is: 0 where
            errors may well be independent.
    """

    factor: float
    correlated: Array
    clear_share: float

    def covariance(self, position: Array, overlapping: Array) -> Array:
        """Covariance (n, n) of normalised errors.

        Args:
            position: (n, 2) of the measures, sides of the image.
            overlapping: (n, n) correlation by overlapping chips.
        """
        total = (self.factor - self.correlated.sum()) * overlapping
        if self.correlated.sum() > 0.0:
            distance = _distance(position)
            for part, length in zip(self.correlated, _LENGTHS, strict=True):
                total += part * np.exp(-distance / length)
        return np.asarray(total)


def overlap_correlation(position_px: Array, side_px: float, own_share: Array) -> Array:
    """Correlation (n, n) of measures whose chips share pixels of the scene.

    The noise of two measures is common in the share of the pixels that both chips cover: discs of the
    area of a chip, which have no direction.

    Args:
        position_px: (n, 2) of the measures.
        side_px: of a chip in the scene; 0 where chips share nothing.
        own_share: (n,) share of a measure's variance that is its own, not that of its point.
    """
    if side_px <= 0.0:
        return np.eye(len(position_px))
    apart = _distance(position_px) / (side_px * 2.0 / np.sqrt(np.pi))
    first, second = np.nonzero(apart < 1.0)
    apart = apart[first, second]
    overlap = (np.arccos(apart) - apart * np.sqrt(1.0 - apart**2)) * 2.0 / np.pi
    correlation = np.zeros((len(position_px), len(position_px)))
    correlation[first, second] = overlap * np.sqrt(own_share[first] * own_share[second])
    np.fill_diagonal(correlation, 1.0)
    return np.asarray(correlation)


def offset_sigma_px(
    fit: AffineFit,
    active: BoolArray,
    free: BoolArray,
    slope_px: float,
    *,
    unit: float,
    stated_px: Array,
) -> tuple[Array, float]:
    """Standard deviations of the offsets of blocks around the frame they scatter about, pixels.

    It is that of their frames where it is stated, else one pixel, within what the disagreement of the
    blocks allows: at least their scatter beyond chance, at most the variance whose 90 % region would
    be that of Student's law with the few degrees of freedom of this scatter. Blocks that agree well are
    so held together, and frames that are known to many metres only do not loosen them.

    Args:
        fit: with offsets that are hardly held.
        active: (n,) measures.
        free: (2, 3) parameters of the correction.
        slope_px: a priori standard deviation of drift and skew.
        unit: standard deviation of unit weight.
        stated_px: (2, b) of the frames of the blocks; NaN where it is not stated.

    Returns:
        (2, b) a priori, and what the blocks were seen to be apart beyond chance.
    """
    parameters, covariance = fit.solution(active, free, slope_px)
    blocks = fit.member.shape[1]
    centring = np.eye(blocks) - 1.0 / blocks
    apart = parameters[:, 3:] @ centring
    freedom = 2.0 * (blocks - 1)
    scatter = float((apart**2).sum() / freedom)
    by_chance = unit**2 * float(np.einsum("ij,kji->", centring, covariance[:, 3:, 3:]) / freedom)
    least = max(0.0, scatter - by_chance)
    most = _few_degrees(freedom) * max(scatter, by_chance)
    expected = np.where(np.isfinite(stated_px), stated_px, _UNKNOWN_OFFSET_PX) ** 2
    return np.sqrt(np.clip(expected, least, most)), float(np.sqrt(least))


def _few_degrees(freedom: float) -> float:
    """Ratio of the squared radii of the 90 % regions of Student's and the normal law in the plane."""
    return float(freedom * (0.1 ** (-2.0 / freedom) - 1.0) / (2.0 * np.log(10.0)))


def likeliest_shared_errors(
    fit: AffineFit,
    active: BoolArray,
    free: BoolArray,
    slope_px: float,
    *,
    position: Array,
    overlapping: Array,
) -> SharedErrors:
    """What the residuals of a scene tell of its errors, averaged over what may be.

    Correlation: restricted likelihood (Patterson and Thompson, 1971) of every share and length on a
    small grid. Unit: stated sigmas are true, or off by any factor, all being as likely on a logarithmic
    scale; the mean of its square is then chi^2 / (nu - 2), more than chi^2 / nu where there are few
    degrees of freedom.

    Measures are judged by their neighbours first. To leave out what is far from the fit of the whole
    image removes patches where a common error is large; to keep what is far from its neighbours makes
    smooth errors look rough. Both hide what is shared.

    Args:
        fit: of the measures.
        active: (n,) measures, also those that were deactivated later.
        free: (2, 3) parameters of the correction.
        slope_px: a priori standard deviation of drift and skew.
        position: (n, 2) sides of the image.
        overlapping: (n, n) correlation by overlapping chips.
    """
    rows = np.flatnonzero(active)
    # Evenly over the image, whatever the order of the measures.
    rows = rows[np.lexsort((position[rows, 1], position[rows, 0]))]
    rows = rows[:: -(-len(rows) // _ENOUGH)]
    estimated = fit.estimated(free)
    system = _WhitenedSystem(
        design=fit.design[rows] * estimated[:, None, :] / fit.sigma[rows].T[:, :, None],
        measured=(fit.misfit[rows] / fit.sigma[rows]).T[:, :, None],
        expected=fit.expected(slope_px),
        estimated=estimated,
    )
    base = overlapping[np.ix_(rows, rows)]
    distance = _distance(position[rows])
    smooth = [np.exp(-distance / length) for length in _LENGTHS]
    cases = [(0.0, 0)] + [(share, k) for k in range(len(_LENGTHS)) for share in _SHARES]
    prior = np.full(len(cases), (1.0 - _INDEPENDENT) / (len(cases) - 1))
    prior[0] = _INDEPENDENT
    correlations = [(1.0 - share) * base + share * smooth[k] for share, k in cases]
    clipped = system.clipped(correlations[_MIDDLE])
    told = [clipped.told_by(correlation) for correlation in correlations]
    evidence = np.array([one.log_evidence for one in told]) + np.log(prior)
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    shares, lengths = (np.array(column) for column in zip(*cases, strict=True))
    part = weight * shares * [one.as_seen for one in told]
    return SharedErrors(
        factor=float(weight @ [one.factor for one in told]),
        correlated=np.asarray(np.bincount(lengths, part, len(_LENGTHS)), dtype=np.float64),
        clear_share=float(weight @ shares) * max(0.0, 1.0 - float(weight[0]) / _UNCLEAR),
    )


@dataclass(frozen=True)
class _Told:
    """What the residuals tell of one case.

    Attributes:
        log_evidence: logarithm of its likelihood.
        factor: mean of the variance of unit weight, at least 1.
        as_seen: mean of the variance of unit weight, whatever it is.
    """

    log_evidence: float
    factor: float
    as_seen: float


@dataclass(frozen=True)
class _WhitenedSystem:
    """Measures in units of their standard deviations.

    Attributes:
        design: (2, n, k) of line and sample; zero where a parameter is not estimated.
        measured: (2, n, 1).
        expected: (2, k) a priori weights of the parameters.
        estimated: (2, k) parameters that are.
    """

    design: Array
    measured: Array
    expected: Array
    estimated: BoolArray

    def clipped(self, correlation: Array) -> "_WhitenedSystem":
        """The system where measures far from what all others predict (n, n correlation) are less far."""
        # The residual of a measure that is left out is (P y)_i / P_ii, its variance 1 / P_ii.
        inverse = np.linalg.inv(correlation + 1e-6 * np.eye(len(correlation)))
        weighted = inverse @ self.design
        information = self.design.transpose(0, 2, 1) @ weighted
        covariance = inverse_normal(information, self.expected, self.estimated)
        projection = inverse - weighted @ covariance @ weighted.transpose(0, 2, 1)
        precision = np.maximum(np.diagonal(projection, 0, 1, 2), 1e-6)[:, :, None]
        count = self.measured.size
        freedom = max(count - float(np.trace(covariance @ information, axis1=1, axis2=2).sum()), 1.0)
        clip = _CLIP * MAD_TO_STD * float(np.sqrt(count / freedom))
        measured = self.measured
        # Twice: a wrong measure spoils what is predicted of its neighbours.
        for _ in range(2):
            left_out = projection @ measured / precision
            normalised = np.abs(left_out) * np.sqrt(precision)
            most = max(clip * float(np.median(normalised)), 1e-9)
            share = np.minimum(1.0, most / np.maximum(normalised.max(axis=0), 1e-9))
            measured = measured - (1.0 - share) * left_out
        return replace(self, measured=measured)

    def told_by(self, correlation: Array) -> _Told:
        """What the residuals tell, if they have this correlation (n, n)."""
        count, size = self.design.shape[1:]
        lower = np.linalg.cholesky(correlation + 1e-9 * np.eye(count))
        columns = np.concatenate([*self.design, *self.measured], axis=1)
        whitened = solve_triangular(lower, columns, lower=True, check_finite=False)
        design = np.stack([whitened[:, :size], whitened[:, size : 2 * size]])
        measured = whitened[:, 2 * size :].T[:, :, None]
        information = design.transpose(0, 2, 1) @ design
        inverse = inverse_normal(information, self.expected, self.estimated)
        residual = measured - design @ (inverse @ (design.transpose(0, 2, 1) @ measured))
        chi2 = max(float((residual**2).sum()), 1e-12) / _CLIPPED_VARIANCE
        taken = float(np.trace(inverse @ information, axis1=1, axis2=2).sum())
        freedom = max(2.0 * count - taken, 1e-3)
        # What is not estimated has no variance and no part in the determinant.
        filled = inverse + ~self.estimated[:, :, None] * np.eye(size)
        determinant = 4.0 * np.log(np.diag(lower)).sum() - np.linalg.slogdet(filled)[1].sum()
        log_evidence, factor, as_seen = _variance_of_unit(chi2, freedom)
        return _Told(log_evidence - 0.5 * float(determinant), factor, as_seen)


def _variance_of_unit(chi2: float, freedom: float) -> tuple[float, float, float]:
    """Log-evidence of a sum of squared residuals; means of the variance of unit weight.

    The first mean is that of a variance of at least 1, the second of any.
    """
    middle = float(np.sqrt(chi2 / freedom))
    sigma = np.geomspace(min(0.1, 0.1 * middle), max(10.0, 10.0 * middle), 400)
    step = float(np.log(sigma[1] / sigma[0]))
    sigma = np.append(sigma, 1.0)
    prior = np.full(len(sigma), (1.0 - _STATED_IS_TRUE) * step / np.log(100.0))
    prior[-1] = _STATED_IS_TRUE
    logarithm = np.log(prior) - freedom * np.log(sigma) - chi2 / (2.0 * sigma**2)
    weight = np.exp(logarithm - logarithm.max())
    evidence = float(np.log(weight.sum()) + logarithm.max())
    weight /= weight.sum()
    return evidence, float(weight @ np.maximum(sigma, 1.0) ** 2), float(weight @ sigma**2)


def _distance(position: Array) -> Array:
    """Distances (n, n) of positions (n, 2)."""
    return cdist(position, position)
