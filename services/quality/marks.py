"""Results for each mark of a registration, and the best place for one more mark."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from amers.services.misfit.marked_scene import MarkedScene, MarkPriors
from amers.services.quality.normal_law import normal_ce90
from amers.services.quality.predicted import predict_accuracy
from amers.services.quality.stability import AdjustedScene
from amers.services.types import Array, IntArray

MarkStatus = Literal["used", "rejected", "in doubt"]

_PARAMETERS = (
    ("shift in line", "drift of the line along the lines", "skew of the line along the samples"),
    ("shift in sample", "skew of the sample along the lines", "drift of the sample along the samples"),
)
_CANDIDATES = 11
"""Places along each side of the image where one more mark is considered."""
_BORDER = 0.05
"""Share of the image along its border where none is: a person needs the surroundings of a detail."""

_MOST_LEFT_OUT = 50
"""Marks beside other points that are left out one by one: each repeats the adjustment of all of them."""


@dataclass(frozen=True)
class MarkResult:
    """What became of one mark.

    Attributes:
        point: its number among the control points: -1, -2 and so on.
        name: of the mark.
        line, sample: where the image shows it, pixels.
        lon, lat, height_m: its ground, above the ellipsoid.
        sigma_px: of the pick, each coordinate.
        sigma_m: of the ground, east, north, up.
        residual_px: observed minus computed, line and sample.
        left_out_px: observed minus computed without this mark, line and sample; null for a single one.
        left_out_sigma_px: standard deviation of that, by what is stated of the marks.
        status: "used", "rejected", or "in doubt" where marks disagree and nothing shows which are wrong.
        note: in words, "" where there is nothing to say.
    """

    point: int
    name: str
    line: float
    sample: float
    lon: float
    lat: float
    height_m: float
    sigma_px: float
    sigma_m: Array
    residual_px: Array
    left_out_px: Array
    left_out_sigma_px: Array
    status: MarkStatus
    note: str


@dataclass(frozen=True)
class NextMark:
    """Where one more mark, as precise as those there are, would help most.

    Attributes:
        line, sample: the place in the image.
        lon, lat: the ground there, at the middle height of the marks; null where the model has none.
        ce90_px, ce90_m: predicted CE90 at the worst place of the image with it.
    """

    line: float
    sample: float
    lon: float
    lat: float
    ce90_px: float
    ce90_m: float


@dataclass(frozen=True)
class MarksReport:
    """The marks of a registration.

    Attributes:
        marks: in the order of their files.
        prior_shift_px, prior_slope_px: a priori standard deviations of the shift, and of drift and skew
            at the edge of the image, as the marks leave them; the first is null beside other points.
        held: parameters that these determine, not the marks.
        next_mark: what one more mark would bring.
        words: all this in sentences.
    """

    marks: tuple[MarkResult, ...]
    prior_shift_px: float
    prior_slope_px: float
    held: tuple[str, ...]
    next_mark: NextMark
    words: tuple[str, ...]


def marks_report(
    scene: AdjustedScene, marked: MarkedScene, names: Sequence[str], sigma_m: Array
) -> MarksReport:
    """What a registration on n marks says of them.

    Args:
        scene: after its adjustment, with the marks as its measures.
        marked: the adjustment.
        names: of the marks.
        sigma_m: (n, 3) of their ground.
    """
    measures, notes = scene.measures, _notes(marked, names)
    used: MarkStatus = "in doubt" if marked.disagree else "used"
    marks = tuple(
        MarkResult(
            point=int(measures.point_id[row]),
            name=name,
            line=float(measures.line_sample[row, 0]),
            sample=float(measures.line_sample[row, 1]),
            lon=float(measures.lon_lat_h[row, 0]),
            lat=float(measures.lon_lat_h[row, 1]),
            height_m=float(measures.lon_lat_h[row, 2]),
            sigma_px=float(measures.sigma_px[row]),
            sigma_m=sigma_m[row],
            residual_px=measures.residual_px[row],
            left_out_px=marked.left_out_px[row],
            left_out_sigma_px=marked.left_out_sigma_px[row],
            status=used if measures.active[row] else "rejected",
            note=notes[row] if measures.matched[row] else "the model has no position for this ground",
        )
        for row, name in enumerate(names)
    )
    held = tuple(np.array(_PARAMETERS)[marked.held].tolist())
    precise = measures.active if measures.active.any() else measures.matched
    following = next_mark(scene, np.median(marked.noise_px2[precise], axis=0))
    return MarksReport(
        marks=marks,
        prior_shift_px=marked.priors.shift_px,
        prior_slope_px=marked.priors.slope_px,
        held=held,
        next_mark=following,
        words=(
            *_agreement_words(marked, names),
            *_prior_words(marked, held),
            *(() if marked.disagree else (_next_words(scene, following),)),
        ),
    )


def marks_beside_points(scene: AdjustedScene, names: Sequence[str], sigma_m: Array) -> MarksReport:
    """What a registration on points says of n marks that are observations of the same adjustment.

    Args:
        scene: after its adjustment; the marks are its last measures.
        names: of the marks.
        sigma_m: (n, 3) of their ground.
    """
    n = len(names)
    rows = np.arange(len(scene.measures.point_id) - n, len(scene.measures.point_id))
    of_marks = replace(scene, measures=scene.measures.take(rows))
    adjustment = scene.adjustment
    measures = of_marks.measures
    derivative = scene.model.project_derivative(measures.lon_lat_h)
    ground_m2 = sigma_m[:, None, :] ** 2 * np.eye(3)
    noise_px2 = derivative @ ground_m2 @ derivative.transpose(0, 2, 1)
    noise_px2 = noise_px2 + measures.sigma_px[:, None, None] ** 2 * np.eye(2)
    spread = adjustment.covariance_at(measures.line_sample) + noise_px2
    marked = MarkedScene(
        adjustment=replace(adjustment, active=measures.active, residual_px=measures.residual_px),
        priors=MarkPriors(np.nan, adjustment.slope_px),
        held=np.zeros((2, 3), dtype=np.bool_),
        left_out_px=_without_each(scene, rows),
        left_out_sigma_px=np.sqrt(np.diagonal(spread, 0, 1, 2)),
        noise_px2=noise_px2,
        alternative=np.full(n, -1, dtype=np.int64),
        disagree=False,
    )
    return marks_report(of_marks, marked, names, sigma_m)


def _without_each(scene: AdjustedScene, rows: IntArray) -> Array:
    """Misfit (n, 2) of measures at some rows (n,) against the adjustment without each of them.

    That of a rejected one is its residual; in a block of many scenes, and of many marks, the others are
    not known.
    """
    left_out_px = scene.measures.residual_px[rows].copy()
    if scene.refit is None or len(rows) > _MOST_LEFT_OUT:
        left_out_px[scene.measures.active[rows]] = np.nan
    for number, row in enumerate(rows.tolist()):
        if not scene.measures.active[row] or scene.refit is None or len(rows) > _MOST_LEFT_OUT:
            continue
        used = scene.measures.active.copy()
        used[row] = False
        predicted = scene.measures.predicted[row][None]
        shown = scene.measures.line_sample[row]
        left_out_px[number] = shown - scene.refit(used).correction.apply(predicted)[0]
    return left_out_px


def next_mark(scene: AdjustedScene, noise_px2: Array) -> NextMark:
    """The place in the image where one more mark lowers the largest predicted CE90 most.

    No observation is needed: a mark changes the covariance of a correction by its place and its sigma
    alone.

    Args:
        scene: after its adjustment.
        noise_px2: (2, 2) covariance of the mark, of its pick and of its ground.
    """
    adjustment, shape = scene.adjustment, scene.shape
    candidates = _grid(shape, _CANDIDATES, _BORDER)
    places = _grid(shape, 7, 0.0)
    with_one = [_with_mark(scene, place, noise_px2) for place in candidates]
    largest = [
        normal_ce90(replace(adjustment, covariance=one).covariance_at(places)).max() for one in with_one
    ]
    best = int(np.argmin(np.round(largest, 6)))
    predicted = predict_accuracy(
        replace(scene, adjustment=replace(adjustment, covariance=with_one[best])), 7
    )
    height_m = np.array([np.median(scene.measures.lon_lat_h[:, 2])])
    lon, lat, _ = scene.model.locate(candidates[best][None], height_m)[0]
    line, sample = candidates[best]
    return NextMark(
        float(line), float(sample), float(lon), float(lat), predicted.worst_px, predicted.worst_m
    )


def _grid(shape: tuple[int, int], nodes: int, border: float) -> Array:
    """Image positions (nodes^2, 2) from border to border."""
    axes = [np.linspace(border * (size - 1), (1.0 - border) * (size - 1), nodes) for size in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def _with_mark(scene: AdjustedScene, place: Array, noise_px2: Array) -> Array:
    """Covariance (6, 6) of a correction after one more mark at a place (2,) of the image."""
    adjustment = scene.adjustment
    correction, covariance = adjustment.correction, adjustment.covariance
    t = (correction.invert(place[None])[0] - correction.centre) / correction.half_size
    design = np.kron(np.eye(2), [1.0, *t])
    spread = design @ covariance
    return np.asarray(covariance - spread.T @ np.linalg.solve(spread @ design.T + noise_px2, spread))


def _notes(marked: MarkedScene, names: Sequence[str]) -> list[str]:
    """What is said of each mark."""
    return [
        f"mark {names[other]} may be the wrong one in its place" if other >= 0 else ""
        for other in marked.alternative.tolist()
    ]


def _agreement_words(marked: MarkedScene, names: Sequence[str]) -> tuple[str, ...]:
    """Whether the marks agree, and which were rejected."""
    active = marked.adjustment.active
    off_px = np.hypot(*marked.left_out_px.T)
    if marked.disagree:
        worst = np.nanargmax(off_px)
        return (
            f"The {active.sum()} marks disagree beyond their sigmas, by up to {off_px[worst]:.1f} px "
            "against the others, and nothing shows which are wrong: check them, or mark more points",
        )
    rejected = np.flatnonzero(~active & np.isfinite(off_px)).tolist()
    words = [
        f"Mark {names[row]} is not used: it is {off_px[row]:.1f} px off the other marks"
        + (
            ""
            if marked.alternative[row] < 0
            else f"; mark {names[marked.alternative[row]]} may be the wrong one in its place"
        )
        for row in rejected
    ]
    if active.sum() == 1 and np.isfinite(marked.priors.shift_px):
        words.append("A single mark is used, and nothing checks it: mark a second point")
    return tuple(words)


def _prior_words(marked: MarkedScene, held: tuple[str, ...]) -> tuple[str, ...]:
    """What the marks leave to what is known before."""
    if not held:
        return ()
    parts = [f"{name} ({marked.priors.shift_px:.2g} px)" for name in held if "shift" in name]
    slopes = [name for name in held if "shift" not in name]
    if slopes:
        names = "drift and skew" if marked.held[:, 1:].all() else ", ".join(slopes)
        parts.append(f"{names} ({marked.priors.slope_px:.2g} px at the edge of the image)")
    return (f"Held by their a priori standard deviation, not by the marks: {'; '.join(parts)}",)


def _next_words(scene: AdjustedScene, following: NextMark) -> str:
    """What one more mark would bring, as a sentence."""
    now = predict_accuracy(scene, 7)
    place = f"line {following.line:.0f}, sample {following.sample:.0f}"
    if np.isfinite(following.lon):
        place += f" (longitude {following.lon:.6f}, latitude {following.lat:.6f})"
    return (
        f"One more mark like these would lower the predicted CE90 from {now.worst_m:.2f} m to "
        f"{following.ce90_m:.2f} m; it helps most near {place}"
    )
