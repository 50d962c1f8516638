"""A displacement beyond an affine correction, with components for scanners, optics and rectification.

The displacement of each coordinate is a sum of Gaussian processes, the components. Those of images that
were scanned depend on the line or the sample: smooth ones (bow, slow attitude, distortion of the
optics), narrow bands (jitter) and steps (lost or repeated lines, seams between detectors). Those of
ortho-images depend on both, and are smooth (terrain, seams of a mosaic). Components are added while the
residuals show one that chance does not explain and that predicts held-out blocks of lines or samples.
Kernels and variances are those of the largest restricted likelihood (Patterson and Thompson, 1971);
estimate and covariance are those of universal kriging. Where the pixels show a break, there is a step of
any size.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpstrf
from scipy.spatial.distance import cdist
from scipy.special import eval_legendre

from amers.services.misfit.structure import ALONG_AXES, Family, Residuals, Structure, structures
from amers.services.types import Array, IntArray

Along = Literal["lines", "samples", "swath", "image"]
"""Of which a displacement is a function: of the line; of the sample; of the line, in proportion to the
distance from the middle of the swath, as yaw and scale displace; of both."""
_AXES: dict[Along, slice] = {
    "lines": slice(0, 1),
    "samples": slice(1, 2),
    "swath": slice(0, 1),
    "image": slice(0, 2),
}
_OF_SCANNED: dict[Along, tuple[Family, ...]] = {
    "lines": ("lines", "steps"),
    "samples": ("samples", "seams"),
    "swath": ("image",),
}
_FAMILIES: tuple[Family, ...] = (*ALONG_AXES, "image")
_OF_ORTHO: dict[Along, tuple[Family, ...]] = {"image": _FAMILIES}
"""Structures that components of images that were scanned, and of ortho-images, may explain."""

Kind = Literal["smooth", "period", "step", "break", "quadratic", "cubic"]
BENDS: dict[Kind, int] = {"quadratic": 2, "cubic": 3}
"""Degrees of the polynomials over the image that components may be."""

MAX_CHANCE = 0.002
"""Structure that chance explains with a larger probability is not looked into."""
_MOST_COMPONENTS, _MOST_WITH_SEAMS = 3, 6
"""Components, and those with the seams between detectors, which are many where there is one."""
_MOST_POINTS = 200
"""Measures that choose a kernel; more cost more and tell little more."""
_ROUNDS = 2
"""In which components that are found one after the other are estimated again beside each other."""
_LEAST_EVIDENCE = 4.0
"""Logarithm of how many times more likely a component makes the residuals, at least."""
_BLOCKS = 40
"""Blocks of lines, or of samples, of the cross-validation."""
_LEAST_GAIN = 0.97
"""Residuals of held-out blocks with a component over those without, at most."""
_LOOSE = 100.0
"""Variance of components, over the likeliest one, for tests of what they leave."""
_RATIOS = np.concatenate([[0.0], np.geomspace(0.03, 3000.0, 21)])
"""Variances of a component that are tried, over the median variance of the measures."""
_LENGTHS: dict[Along, tuple[float, ...]] = {
    "lines": (0.04, 0.08, 0.15, 0.3, 0.6, 1.2),
    "samples": (0.6, 1.2),
    "swath": (0.3, 0.6, 1.2),
    "image": (0.08, 0.15, 0.3, 0.6, 1.2),
}
"""Correlation lengths of smooth components, extents of the points along the axis.

Along the samples, what is shorter than optics do is a seam between detectors."""
_COHERENCE = (0.15, 0.4, 2.0)
"""Lengths over which a narrow band keeps its phase, the same."""
_FEWEST_OF_SWATH = 24
"""Fewest measures by which turns of lines are followed: with fewer, a turn explains any error."""
_LEAST_SEEN = 0.4
"""Share of its amplitude that chips show of a jitter that can be followed."""
_FINE = 8
"""Periods tried around a peak, for each that independent residuals tell apart."""
_OF_POINTS = 2.0
"""Mean square of what displaces an ortho-image over the variance of its points, more than is theirs."""
_NEGLIGIBLE = 1e-10
"""Share of the variance of a component that its factor may leave out."""
_ISOTROPIC = (0.05, 0.1, 0.2)
"""Lengths of errors that neighbours share in all directions, sides of the image: what else may be."""


@dataclass(frozen=True)
class Component:
    """One component of a displacement.

    Attributes:
        kind: "smooth", "period", "step" or "break", which is a step that the pixels show; bends over
            the image are "quadratic" or "cubic".
        length_px: over which it is correlated; of a step, the width of the gap that holds it; of a bend,
            half the side of the image.
        at_px: period; first line, or sample, of the gap that holds a step; middle of a bend; middle of
            the swath.
        variance_px2: (2,) of line and sample, as chips show it, if the stated variances of the measures
            are true: what these are off by, it is off by, too.
        seen: share of the amplitude that chips show, which average over their pixels.
        along: what it is a function of.
    """

    kind: Kind
    length_px: float
    at_px: float
    variance_px2: Array
    seen: float = 1.0
    along: Along = "lines"

    @property
    def axes(self) -> slice:
        """Of the positions that it depends on: line, sample, or both."""
        return _AXES[self.along]

    @property
    def is_step(self) -> bool:
        """Whether it displaces all that lies behind a line, or sample, alike."""
        return self.kind in ("step", "break")

    @property
    def is_seam(self) -> bool:
        """Whether it is a step along the samples."""
        return self.kind == "step" and self.along == "samples"

    def polynomial(self, line_sample: Array) -> Array:
        """Value (...) of a bend at positions (..., 2), 1 at the last line or sample."""
        unit = (line_sample[..., self.axes.start] - self.at_px) / self.length_px
        return np.asarray(eval_legendre(BENDS[self.kind], unit))

    def share(self, line_sample: Array) -> Array:
        """Share (...) of its variance at positions (..., 2): before a step there is none."""
        if self.kind in BENDS:
            return self.polynomial(line_sample) ** 2
        if self.is_step:
            behind_px = line_sample[..., self.axes.start] - self.at_px
            return np.clip(behind_px / self.length_px, 0.0, 1.0)
        return self._lever(line_sample) ** 2

    def _lever(self, line_sample: Array) -> Array:
        """Factor (...) at positions (..., 2): across the swath, 0 in its middle and -1 at sample 0."""
        if self.along == "swath":
            return line_sample[..., 1] / self.at_px - 1.0
        return np.ones(line_sample.shape[:-1])

    def correlation(self, first: Array, second: Array) -> Array:
        """Correlation (m, n) of the displacements at positions (m, 2) and (n, 2)."""
        if self.kind in BENDS:
            return np.outer(self.polynomial(first), self.polynomial(second))
        if self.is_step:
            return np.minimum(self.share(first)[:, None], self.share(second)[None, :])
        apart2 = cdist(first[:, self.axes], second[:, self.axes], "sqeuclidean")
        smooth = np.exp(apart2 * (-0.5 / self.length_px**2))
        if self.along == "swath":
            smooth *= np.outer(self._lever(first), self._lever(second))
        if self.kind == "smooth":
            return np.asarray(smooth)
        first_px, second_px = (places[:, self.axes.start] for places in (first, second))
        turns = (first_px[:, None] - second_px[None, :]) / self.at_px
        return np.asarray(smooth * np.cos(2.0 * np.pi * turns))

    def covariance(self, first: Array, second: Array) -> Array:
        """Covariance (2, m, n) of what chips show at positions (m, 2) and (n, 2), of line and sample."""
        return np.asarray(self.variance_px2[:, None, None] * self.correlation(first, second))

    def scaled(self, factor: float) -> "Component":
        """The same component with its variance multiplied by a factor; bends are pixels in any case."""
        if self.kind in BENDS:
            return self
        return replace(self, variance_px2=self.variance_px2 * factor)


@dataclass(frozen=True)
class _Judged:
    """A component and how likely it makes the residuals.

    Attributes:
        component: with its likeliest variances.
        log_evidence: over that of no component.
    """

    component: Component | None
    log_evidence: float


def likeliest_components(
    residuals: Residuals,
    extent_px: float,
    known: Sequence[Component] = (),
    *,
    scanned: bool = True,
    points_px2: float = 0.0,
) -> tuple[tuple[Component, ...], tuple[Structure, ...]]:
    """The components that residuals of an affine correction show, and what they leave along the axes.

    Args:
        residuals: of the active measures.
        extent_px: side of the image, to which errors that neighbours share are compared.
        known: steps at breaks of the image, which there are whatever the residuals show.
        scanned: whether the image was scanned line by line. Of an ortho-image, what depends on line and
            sample together is followed, unless the points explain it: they may err together, by as
            much as they state.
        points_px2: variance of a coordinate of a measure by its point.
    """
    residuals = beside_breaks(residuals, known)
    followed_by = _OF_SCANNED if scanned else _OF_ORTHO
    components: list[Component] = []
    told = 0.0
    affine = found = structures(residuals, _FAMILIES)
    if scanned and structures(residuals, ("height",))[0].chance < min(one.chance for one in affine):
        # Relief that the model sees from another side turns lines, too.
        followed_by = {along: families for along, families in followed_by.items() if along != "swath"}
    while True:
        clearest = min(found, key=lambda one: one.chance)
        if clearest.chance > MAX_CHANCE or len(components) == _MOST_WITH_SEAMS:
            break
        followed = with_components(residuals, components)
        thinned = _thinned(followed)
        best = _System.of(thinned).best(_candidates(thinned, found, followed_by))
        if best.component is None or best.log_evidence <= _LEAST_EVIDENCE:
            break
        if len(components) >= _MOST_COMPONENTS and not best.component.is_seam:
            break
        richer = with_components(followed, [best.component])
        blocks = _blocks(residuals, best.component)
        if held_out_rms(richer, blocks) > _LEAST_GAIN * held_out_rms(followed, blocks):
            break
        told += best.log_evidence
        components = _again(residuals, [*components, best.component])
        found = structures(beyond(residuals, components), _FAMILIES)
    if components:
        if scanned:
            explained = told <= _LEAST_EVIDENCE + _of_shared_errors(residuals, extent_px)
        else:
            explained = _displaced_px2(residuals, components) <= _OF_POINTS * points_px2
        if explained:
            components, found = [], affine
    return (*known, *components), found[: len(ALONG_AXES)]


def _again(residuals: Residuals, components: list[Component]) -> list[Component]:
    """The same components, each as likely as it can be beside the others.

    What was not yet followed when a component was found looked like noise, beside which it was small.
    """
    if len(components) == 1:
        return components
    thinned = _thinned(residuals)
    for k in list(range(len(components))) * _ROUNDS:
        one = components[k]
        beside = with_components(thinned, components[:k] + components[k + 1 :])
        variants = _smooth(thinned, one.along) if one.kind == "smooth" else [one]
        components[k] = _System.of(beside).best(variants).component or one
    return components


def with_components(residuals: Residuals, components: Sequence[Component]) -> Residuals:
    """The same residuals, with the covariance of the components added to theirs."""
    place = residuals.line_sample
    covariance = residuals.covariance.copy()
    for component in components:
        covariance += component.covariance(place, place)
    return replace(residuals, covariance=covariance)


def beyond(residuals: Residuals, components: Sequence[Component]) -> Residuals:
    """The residuals without everything that the components can follow, for tests."""
    loose = [component.scaled(_LOOSE) for component in components if component.kind != "break"]
    return with_components(beside_breaks(residuals, components), loose)


def beside_breaks(residuals: Residuals, components: Sequence[Component]) -> Residuals:
    """The residuals of an adjustment that estimates the steps at breaks as well."""
    steps = [one.share(residuals.line_sample) for one in components if one.kind == "break"]
    return replace(residuals, design=np.column_stack([residuals.design, *steps]))


def unit_variance(residuals: Residuals) -> float:
    """Variance of unit weight of whitened residuals."""
    _, bases, left = residuals.whitened
    return float((left**2).sum() / max(left.size - 2 * bases.shape[2], 1))


def _blocks(residuals: Residuals, component: Component) -> IntArray:
    """Number (n,) of the block of lines, of samples or of both that each measure lies in."""
    position = residuals.line_sample[:, component.axes]
    blocks = _BLOCKS ** (1.0 / position.shape[1])
    length = np.maximum(residuals.chip_side_px, np.ptp(position, axis=0) / blocks)
    block = np.floor((position - position.min(axis=0)) / np.maximum(length, 1e-9))
    return np.unique(block, axis=0, return_inverse=True)[1].astype(np.int64).ravel()


def held_out_rms(residuals: Residuals, blocks: IntArray) -> float:
    """Residuals of blocks (n,) of measures predicted from all others: robust rms, pixels."""
    held = np.empty_like(residuals.misfit)
    for k in range(2):
        inverse = np.linalg.inv(residuals.covariance[k])
        weighted = inverse @ residuals.design
        projection = inverse - weighted @ np.linalg.pinv(residuals.design.T @ weighted) @ weighted.T
        pulled = projection @ residuals.misfit[:, k]
        for block in range(blocks.max() + 1):
            rows = np.flatnonzero(blocks == block)
            held[rows, k] = np.linalg.lstsq(projection[np.ix_(rows, rows)], pulled[rows], rcond=1e-9)[0]
    square = (held**2).sum(axis=1)
    return float(np.sqrt(np.mean(np.minimum(square, 9.0 * np.median(square)))))


def _displaced_px2(residuals: Residuals, components: Sequence[Component]) -> float:
    """Mean square of what components displace the measures by beyond affine, of the worse coordinate."""
    full, place = with_components(residuals, components), residuals.line_sample
    moved = np.zeros_like(residuals.misfit)
    for k in range(2):
        inverse = np.linalg.inv(full.covariance[k])
        weighted = inverse @ full.design
        normal = np.linalg.pinv(full.design.T @ weighted, hermitian=True)
        pulled = inverse @ full.misfit[:, k] - weighted @ (normal @ (weighted.T @ full.misfit[:, k]))
        moved[:, k] = sum(one.covariance(place, place)[k] @ pulled for one in components)
    affine = np.linalg.lstsq(residuals.design, moved, rcond=None)[0]
    return float(np.mean((moved - residuals.design @ affine) ** 2, axis=0).max())


def _of_shared_errors(residuals: Residuals, extent_px: float) -> float:
    """Logarithm of how much more likely errors that neighbours share make the residuals; 0 at least."""
    thinned = _thinned(residuals)
    system = _System.of(thinned)
    distance = np.linalg.norm(thinned.line_sample[:, None] - thinned.line_sample[None], axis=2)
    shared = [system.judge(None, np.exp(-distance / (one * extent_px))) for one in _ISOTROPIC]
    return max(0.0, max(one.log_evidence for one in shared))


def _thinned(residuals: Residuals) -> Residuals:
    """At most `_MOST_POINTS` of the measures, evenly along the lines."""
    step = -(-len(residuals.misfit) // _MOST_POINTS)
    rows = np.argsort(residuals.line_sample[:, 0])[::step]
    return Residuals(
        residuals.line_sample[rows],
        residuals.height_m[rows],
        residuals.height_pull,
        residuals.misfit[rows],
        residuals.covariance[:, rows[:, None], rows[None, :]],
        residuals.design[rows],
        residuals.chip_side_px,
    )


def _candidates(
    residuals: Residuals, found: Sequence[Structure], followed_by: Mapping[Along, Sequence[Family]]
) -> list[Component]:
    """Components of unit variance that may explain a structure."""
    candidates = []
    for along, families in followed_by.items():
        if along == "swath" and len(residuals.misfit) < _FEWEST_OF_SWATH:
            continue
        shown = [one for one in found if one.family in families]
        if min(one.chance for one in shown) <= MAX_CHANCE:
            candidates += _smooth(residuals, along)
            if along in ("lines", "samples"):
                candidates += _sharp(residuals, shown, along)
    return candidates


def _smooth(residuals: Residuals, along: Along) -> list[Component]:
    """Smooth components of unit variance."""
    side = residuals.chip_side_px
    position = residuals.line_sample[:, _AXES[along]]
    extent = max(float(np.ptp(position, axis=0).max()), 1e-9)
    lengths = [length * extent for length in _LENGTHS[along] if length * extent >= 0.5 * side]
    seen = [(1.0 + (side / length) ** 2 / 12.0) ** (-0.5 * position.shape[1]) for length in lengths]
    middle = float(np.mean([residuals.line_sample[:, 1].min(), residuals.line_sample[:, 1].max()]))
    at_px = max(middle, 1.0) if along == "swath" else np.nan
    return [
        Component("smooth", length, at_px, np.ones(2), part, along)
        for length, part in zip(lengths, seen, strict=True)
    ]


def _sharp(residuals: Residuals, found: Sequence[Structure], along: Along) -> list[Component]:
    """Jitter along the lines, and steps, of unit variance, that may explain a structure."""
    position = residuals.line_sample[:, _AXES[along].start]
    extent = max(float(np.ptp(position)), 1e-9)
    one = np.ones(2)
    side = residuals.chip_side_px
    candidates = []
    for structure in found:
        if structure.shape == "period" and along == "lines":
            frequency = 1.0 / structure.at + np.arange(-_FINE // 2, _FINE // 2 + 1) / (_FINE * extent)
            periods = 1.0 / frequency[frequency > 0.25 / extent]
            phase = 2.0 * np.pi * position / periods[:, None]
            gain, _ = residuals.gains(np.stack([np.cos(phase), np.sin(phase)], axis=-1))
            period = float(periods[np.argmax(gain)])
            seen = float(np.sinc(side / period))
            if seen < _LEAST_SEEN:
                continue
            candidates += [Component("period", one_ * extent, period, one, seen) for one_ in _COHERENCE]
        elif structure.shape == "step":
            ordered = np.unique(position)
            after = int(np.searchsorted(ordered, structure.at))
            start = float(ordered[after - 1])
            width = float(ordered[after]) - start
            candidates.append(Component("step", width, start, one, along=along))
    return candidates


@dataclass(frozen=True)
class _System:
    """Whitened measures of each coordinate, without what the design explains.

    Attributes:
        place: (n, 2) line and sample.
        lower: (2, n, n) Cholesky factors of the covariance.
        bases: (2, n, k) of the design.
        left: (2, n) measures without what it explains.
        unit_px2: (2,) median variance of a measure.
    """

    place: Array
    lower: Array
    bases: Array
    left: Array
    unit_px2: Array

    @classmethod
    def of(cls, residuals: Residuals) -> "_System":
        diagonal = np.diagonal(residuals.covariance, 0, 1, 2)
        return cls(residuals.line_sample, *residuals.whitened, np.median(diagonal, axis=1))

    def best(self, candidates: Sequence[Component]) -> _Judged:
        """The most likely of some components, with its likeliest variances."""
        judged = [self.judge(one, one.correlation(self.place, self.place)) for one in candidates]
        return max(judged, key=lambda one: one.log_evidence, default=_Judged(None, 0.0))

    def judge(self, component: Component | None, correlation: Array) -> _Judged:
        """The likeliest variances of a component with this correlation (n, n), and its evidence."""
        factor = _low_rank(correlation)
        ratio = _RATIOS[:, None]
        quadratic, determinant = [], []
        for k in range(2):
            white = solve_triangular(self.lower[k], factor, lower=True, check_finite=False)
            white -= self.bases[k] @ (self.bases[k].T @ white)
            values, vectors = np.linalg.eigh(white.T @ white * self.unit_px2[k])
            spread = 1.0 + ratio * np.maximum(values, 0.0)
            explained = ((self.left[k] @ white @ vectors) ** 2 * self.unit_px2[k] * ratio / spread).sum(
                axis=1
            )
            quadratic.append(self.left[k] @ self.left[k] - explained)
            determinant.append(np.log(spread).sum(axis=1))
        _, n, fixed = self.bases.shape
        freedom = 2 * (n - fixed)
        total = quadratic[0][:, None] + quadratic[1][None, :]
        logarithm = -0.5 * (determinant[0][:, None] + determinant[1][None, :])
        logarithm = logarithm - 0.5 * freedom * np.log(np.maximum(total, 1e-300))
        first, second = np.unravel_index(int(np.argmax(logarithm)), logarithm.shape)
        weight = np.exp(logarithm - logarithm[0, 0] - (peak := float(logarithm.max() - logarithm[0, 0])))
        evidence = peak + float(np.log(weight.mean()))
        if component is None:
            return _Judged(None, evidence)
        if component.kind == "step":
            # The likeliest of the gaps between neighbours: any other was as likely before.
            evidence -= float(np.log(len(self.place)))
        variance = np.array([_RATIOS[first], _RATIOS[second]]) * self.unit_px2
        return _Judged(replace(component, variance_px2=variance), evidence)


def _low_rank(correlation: Array) -> Array:
    """A factor (n, r) of a correlation (n, n), by its product with itself: steps have an r of 1."""
    lower, order, rank, _ = dpstrf(correlation, tol=_NEGLIGIBLE, lower=1)
    factor = np.zeros((len(correlation), rank))
    factor[order - 1] = np.tril(lower)[:, :rank]
    return factor
