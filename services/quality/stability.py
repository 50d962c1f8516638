"""Stability of a correction: the adjustment repeated with fewer points."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from amers.services.errors import ComputationError
from amers.services.imagery.pixel_checks import PixelFinding
from amers.services.matching.chip_shears import ChipShears
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.quality.accuracy import Statistics, statistics
from amers.services.quality.finding import Finding
from amers.services.quality.held_area import HeldArea
from amers.services.quality.normal_law import normal_ce90
from amers.services.quality.points_elsewhere import Elsewhere
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, BoolArray, Frame, IntArray, Measures

PLACES = ("top left", "top right", "bottom right", "bottom left", "centre")


@dataclass(frozen=True)
class AdjustedScene:
    """A scene after its final adjustment.

    Attributes:
        model: of the scene, with the correction of the adjustment.
        measures: all n points that the scene could show, with their final residuals.
        adjustment: of all active points.
        shape: lines and samples of the image.
        gsd_m: ground sampling of the image; it converts pixels to metres.
        frame: of the control on the Earth.
        refit: repeats the adjustment on the measures of a mask (n,); None for a scene whose repetitions
            are those of a block.
        elsewhere: points that agree on another displacement than the rest; None when there are none.
        control_gsd_m: ground sampling of the chips or of the reference that the scene was measured on;
            0 where it was measured on none.
        breaks: first lines behind breaks of the image, where lines are missing or repeated; None where
            it was not looked for any.
        shears: of the chips of active points, with their rows among all; None where it is not known.
        pixel_findings: what is wrong with the pixels.
        model_findings: what the adjusted model, or the file that carries it, is off by.
        tie_places: (k, 2) line and sample of ties with other scenes, which hold the image as well.
        findings: what the correction does not follow; their harm is in the adjustment.
        held: the part of the image that points support; None before it is known.
    """

    model: SensorModel
    measures: Measures
    adjustment: SceneAdjustment
    shape: tuple[int, int]
    gsd_m: float
    frame: Frame
    refit: Callable[[BoolArray], SceneAdjustment] | None = None
    elsewhere: Elsewhere | None = None
    control_gsd_m: float = 0.0
    breaks: IntArray | None = None
    shears: ChipShears | None = None
    pixel_findings: tuple[PixelFinding, ...] = ()
    model_findings: tuple[Finding, ...] = ()
    tie_places: Array | None = None
    findings: tuple[Finding, ...] = ()
    held: HeldArea | None = None

    @property
    def places(self) -> Array:
        """Line and sample (5, 2) of the corners and the centre, each moved to where points support."""
        places = image_places(self.shape)
        return places if self.held is None else self.held.nearest(places)

    @property
    def worst_ce90_px(self) -> float:
        """CE90 of the worst place in the held area, relative to the points; infinite without one."""
        if self.held is None or not len(self.held.places):
            return math.inf
        return float(normal_ce90(self.adjustment.covariance_at(self.held.places)).max())


Repetition = tuple[IntArray, SceneAdjustment | None]
"""Measures that were held out, and the adjustment without them; None where there was no solution."""


@dataclass(frozen=True)
class ImageResiduals:
    """Residuals of the active points in the image, pixels.

    Attributes:
        x: along samples.
        y: along lines.
        xy: length of the residual.
    """

    x: Statistics
    y: Statistics
    xy: Statistics


@dataclass(frozen=True)
class Displacement:
    """Displacement of one place of the image between the full solution and solutions with fewer points.

    Attributes:
        place: "top left", "top right", "bottom right", "bottom left" or "centre".
        median_px, max_px, median_m, max_m: length, over the repeated adjustments.
    """

    place: str
    median_px: float
    max_px: float
    median_m: float
    max_m: float


@dataclass(frozen=True)
class DrawnDisplacement(Displacement):
    """Displacement of one place over random draws.

    Attributes:
        x_m, y_m: along samples and lines in the first draw: one repeated adjustment, as in the published
            tables.
    """

    x_m: float
    y_m: float


@dataclass(frozen=True)
class GroupMeans:
    """Mean residuals of groups of points that were held out together; null without any.

    Errors that are independent average out in a mean; errors that the points of a group share do not.

    Attributes:
        rms_px: root mean square of their lengths.
        over_independent: root mean square over what independent errors of the size of the residuals
            predict: about 1 when errors are independent.
        over_stated: the same over what the stated covariance of the correction and the size of the
            residuals predict: about 1 or less where the stated accuracy covers what the points share.
    """

    rms_px: float
    over_independent: float
    over_stated: float


@dataclass(frozen=True)
class Stability:
    """The adjustment repeated without a part of its points. It shows stability, not absolute accuracy.

    Attributes:
        kept_share: share of the active points in each draw.
        draws: number of adjustments that succeeded.
        failed_draws: number of adjustments that gave no solution.
        held_out_per_draw: number of points held out of each draw.
        displacements: of the four corners and the centre, each at the nearest place that points support;
            empty when no draw succeeded.
        held_out_px: residuals of the points held out, all draws together; a point counts once for each
            draw without it.
        held_out_m: the same on the ground, by the ground sampling of the image.
        group_means: mean residuals of the points held out together.
        note: why there is no figure; "" otherwise.
    """

    kept_share: float
    draws: int
    failed_draws: int
    held_out_per_draw: int
    displacements: tuple[DrawnDisplacement, ...]
    held_out_px: ImageResiduals
    held_out_m: ImageResiduals
    group_means: GroupMeans
    note: str


def residuals_in_image(residual: Array) -> ImageResiduals:
    """Statistics of residuals (n, 2), line and sample."""
    line, sample = residual[:, 0], residual[:, 1]
    return ImageResiduals(
        x=statistics(sample), y=statistics(line), xy=statistics(np.hypot(line, sample))
    )


def measure_stability(
    scene: AdjustedScene, draws: int, kept_share: float, rng: np.random.Generator
) -> Stability:
    """Displacements and residuals when the adjustment is repeated on random parts of the active points.

    Args:
        scene: after its final adjustment.
        draws: number of repetitions.
        kept_share: share of the active points in each draw.
        rng: draws the points that are held out.
    """
    active = np.flatnonzero(scene.measures.active)
    held_count = len(active) - round(kept_share * len(active))
    drawn = [rng.permutation(active)[:held_count] for _ in range(draws if held_count else 0)]
    return stability_of(scene, kept_share, repetitions_without(scene, drawn))


def stability_of(scene: AdjustedScene, kept_share: float, drawn: Sequence[Repetition]) -> Stability:
    """Displacements and residuals of repeated adjustments, each on a random part of the points.

    Args:
        scene: after its final adjustment.
        kept_share: share of the active points in each draw.
        drawn: the draws.
    """
    repeated = what_repetitions_show(scene, drawn)
    held_count = round(float(np.mean([len(held) for held, _ in drawn]))) if drawn else 0
    return Stability(
        kept_share=kept_share,
        draws=len(repeated.moved_px),
        failed_draws=len(drawn) - len(repeated.moved_px),
        held_out_per_draw=held_count,
        displacements=_drawn_displacements(repeated.moved_px, scene.gsd_m),
        held_out_px=residuals_in_image(repeated.residual_px),
        held_out_m=residuals_in_image(repeated.residual_px * scene.gsd_m),
        group_means=repeated.means,
        note=""
        if len(repeated.moved_px)
        else _why_no_stability(int(scene.measures.active.sum()), held_count),
    )


@dataclass(frozen=True)
class Repeated:
    """Adjustments repeated without some points each.

    Attributes:
        moved_px: (r, 5, 2) displacement of the places, line and sample, of those that succeeded.
        residual_px: (k, 2) of the points held out, all together.
        means: of the residuals of each group.
    """

    moved_px: Array
    residual_px: Array
    means: GroupMeans


def repetitions_without(scene: AdjustedScene, groups: Sequence[IntArray]) -> list[Repetition]:
    """The adjustment of a scene alone repeated without each of these groups of measures."""
    repetitions: list[Repetition] = []
    for held in groups:
        used = scene.measures.active.copy()
        used[held] = False
        try:
            repetitions.append((held, scene.refit(used) if scene.refit else None))
        except ComputationError:
            repetitions.append((held, None))
    return repetitions


def what_repetitions_show(scene: AdjustedScene, repetitions: Sequence[Repetition]) -> Repeated:
    """Displacements and residuals of the points held out, of the repetitions that succeeded."""
    measures, correction = scene.measures, scene.adjustment.correction
    places = scene.places
    moved, residuals, means = [], [np.empty((0, 2))], []
    independent, stated = [], []
    for held, repeated in repetitions:
        if repeated is None:
            continue
        moved.append(repeated.correction.apply(places) - correction.apply(places))
        if not len(held):
            continue
        used = measures.active.copy()
        used[held] = False
        seen = measures.line_sample[held]
        residuals.append(seen - repeated.correction.apply(measures.predicted[held]))
        means.append(residuals[-1].mean(axis=0))
        middle = seen.mean(axis=0)
        independent.append(1.0 / len(held) + _leverage(measures.line_sample[used], middle))
        stated.append((repeated.covariance_at(middle[None])[0], len(held)))
    scatter = _scatter_px2(measures.residual_px[measures.active])
    return Repeated(
        moved_px=np.array(moved).reshape(-1, len(PLACES), 2),
        residual_px=np.concatenate(residuals),
        means=GroupMeans(
            rms_px=_rms(np.array([np.hypot(*mean) for mean in means])),
            over_independent=_over(means, [factor * scatter for factor in independent]),
            over_stated=_over(means, [covariance + scatter / n for covariance, n in stated]),
        ),
    )


def _scatter_px2(residual: Array) -> Array:
    """Covariance (2, 2) of single measures about the correction, by their residuals (n, 2)."""
    most_parameters = 3
    return np.asarray(residual.T @ residual / max(len(residual) - most_parameters, 1))


def _leverage(line_sample: Array, place: Array) -> float:
    """Variance of an affine fit to measures (n, 2) of unit variance, at a place (2,)."""
    middle, size = line_sample.mean(axis=0), max(float(line_sample.std()), 1.0)
    design = np.column_stack([np.ones(len(line_sample)), (line_sample - middle) / size])
    at_place = np.concatenate([[1.0], (place - middle) / size])
    return float(at_place @ np.linalg.pinv(design.T @ design, rcond=1e-6) @ at_place)


def _over(means: Sequence[Array], predicted: Sequence[Array]) -> float:
    """Root mean square of vectors in units of their predicted covariances (2, 2); NaN without any."""
    least = 1e-12 * np.eye(2)
    squared = [
        mean @ np.linalg.solve(one + least, mean) for mean, one in zip(means, predicted, strict=True)
    ]
    return _rms(np.sqrt(np.array(squared) / 2.0))


def _rms(values: Array) -> float:
    """Root mean square of (n,) values; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def image_places(shape: tuple[int, int]) -> Array:
    """Line and sample (5, 2) of the four corners and the centre, in the order of `PLACES`."""
    line, sample = shape[0] - 1.0, shape[1] - 1.0
    return np.array(
        [[0, 0], [0, sample], [line, sample], [line, 0], [line / 2, sample / 2]], dtype=float
    )


def displacements_of(moved_px: Array, gsd_m: float) -> tuple[Displacement, ...]:
    """Lengths over the repetitions of displacements (r, 5, 2) in line and sample; empty without any."""
    if not len(moved_px):
        return ()
    length_px = np.linalg.norm(moved_px, axis=2)
    median, largest = np.median(length_px, axis=0), length_px.max(axis=0)
    return tuple(
        Displacement(
            place=place,
            median_px=float(median[k]),
            max_px=float(largest[k]),
            median_m=float(median[k] * gsd_m),
            max_m=float(largest[k] * gsd_m),
        )
        for k, place in enumerate(PLACES)
    )


def _drawn_displacements(moved_px: Array, gsd_m: float) -> tuple[DrawnDisplacement, ...]:
    """Lengths over the draws, and the first draw, of displacements (d, 5, 2) in line and sample."""
    return tuple(
        DrawnDisplacement(
            **asdict(of_place),
            x_m=float(moved_px[0, k, 1] * gsd_m),
            y_m=float(moved_px[0, k, 0] * gsd_m),
        )
        for k, of_place in enumerate(displacements_of(moved_px, gsd_m))
    )


def _why_no_stability(active: int, held_count: int) -> str:
    """The reason why no draw gave a solution."""
    if held_count == 0:
        return f"{active} active points leave none to hold out"
    return f"{active - held_count} of {active} active points gave no solution in any draw"
