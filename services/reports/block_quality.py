"""Content of the report on the quality of a block: one tree of dataclasses."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

import numpy as np

from amers.services.quality.accuracy_statement import StatedAccuracy
from amers.services.quality.block import (
    HALF_PER_KM2,
    QUARTER_PER_KM2,
    Distribution,
    block_quality,
    distribution,
    produced_accuracy,
)
from amers.services.quality.block_cells import BlockCells, images_per_point, view_ages_years
from amers.services.quality.block_heights import HeightErrors, HeightQuality
from amers.services.quality.block_requirements import (
    VERDICT_WORDS,
    BlockCriterion,
    BlockRequirements,
    BlockVerdict,
    Outcome,
    block_criteria,
    block_verdict,
    outcome_of,
)
from amers.services.quality.density import share_reaching
from amers.services.quality.planimetry import PlanimetricQuality
from amers.services.quality.site_errors import SiteErrors
from amers.services.reports.report import NOT_IN_JSON
from amers.services.statements import Statements
from amers.services.types import Array, ControlPoints

BLOCK_QUALITY_FORMAT = "amers-block-quality/1"


@dataclass(frozen=True)
class AssessedBlock:
    """The block that was assessed.

    Attributes:
        id, version, title: of the block.
        created_at: when it was produced.
        points: number of points.
        images: number of images that their chips were cut from.
        area_km2: of its outline.
        excluded_km2: of the ground in it where no points are expected.
    """

    id: str
    version: str
    title: str
    created_at: datetime
    points: int
    images: int
    area_km2: float
    excluded_km2: float


@dataclass(frozen=True)
class CellQuality:
    """A cell of 0.1 degree that has ground which is not excluded.

    Attributes:
        west, south: degrees; longitudes are those of the outline.
        area_km2: inside the outline and not excluded.
        excluded_km2: inside the outline and excluded.
        points: number of points on the ground that is not excluded.
        points_per_km2: of that ground.
        missing_points: whole points that the cell lacks.
        images: median number of images of a point; null without points.
        short_of_views: points that fewer images show than specified.
        age_years: median age of the newest view of a point; null when unknown.
        outcome: "met", "missed", or "not specified" without a specified density.
    """

    west: float
    south: float
    area_km2: float
    excluded_km2: float
    points: int
    points_per_km2: float
    missing_points: int
    images: float
    short_of_views: int
    age_years: float
    outcome: Literal["met", "missed", "not specified"]


@dataclass(frozen=True)
class DensityQuality:
    """The density of the points.

    Attributes:
        points_per_km2: over all ground that is not excluded.
        share_reaching_half, share_reaching_quarter: share of the cells, weighted by their area, with at
            least 1 point for 2 km2 and for 4 km2.
        cells: each of them.
    """

    points_per_km2: float
    share_reaching_half: float
    share_reaching_quarter: float
    cells: tuple[CellQuality, ...]


@dataclass(frozen=True)
class PlaceOutcome:
    """A place where an accuracy was measured, compared with what is required.

    Attributes:
        place: a site, or a cell of one degree.
        figure: "ce90_m" or "le90_m".
        value: of the figure there; null when nothing was measured.
        limit: what is required, metres.
        outcome: see `BlockCriterion`.
    """

    place: str
    figure: Literal["ce90_m", "le90_m"]
    value: float
    limit: float
    outcome: Outcome


@dataclass(frozen=True)
class MeasuredErrors:
    """Every measured error, for the figures.

    Attributes:
        outline: (k, 2) lon, lat of the block.
        heights: against a height model; None when there was none.
        sites: at sites; those of points, then those of images.
    """

    outline: Array
    heights: HeightErrors | None
    sites: tuple[SiteErrors, ...]


@dataclass(frozen=True)
class Measured:
    """What was measured of a block against references.

    Attributes:
        heights: None when there was no height model.
        planimetry: for points, then for images, where there are sites.
        errors: each error.
    """

    heights: HeightQuality | None
    planimetry: tuple[PlanimetricQuality, ...]
    errors: MeasuredErrors


@dataclass(frozen=True)
class BlockQualityReport:
    """The quality of a block of control points.

    Attributes:
        format: of this document.
        block: what was assessed.
        requirements: requirements for the block.
        verdict: "met", "missed", "not shown" by what was measured, or "not specified".
        verdict_words: the same as a sentence.
        criteria: each figure that is compared with a requirement.
        places: sites and cells of one degree, compared with the required accuracy.
        relative_to_control_points: declared accuracy of the median point, without the block's frame.
        on_the_earth: the same with it.
        density: in cells of 0.1 degree.
        images_per_point: numbers of different images.
        views_per_point: numbers of chips.
        age_years: of the newest view of each point; null when no view has a date.
        heights: against a height model; null when none was given.
        planimetry: at sites with ortho-images, for points and for images; empty without sites.
        assessed_at: UTC; ages are those at this time.
        seconds: that the assessment took.
        software_version: of Amers.
        statements: of the files of the references, and what became of each.
    """

    format: str
    block: AssessedBlock
    requirements: BlockRequirements
    verdict: BlockVerdict
    verdict_words: str
    criteria: tuple[BlockCriterion, ...]
    places: tuple[PlaceOutcome, ...]
    relative_to_control_points: StatedAccuracy
    on_the_earth: StatedAccuracy
    density: DensityQuality
    images_per_point: Distribution
    views_per_point: Distribution
    age_years: Distribution | None
    heights: HeightQuality | None
    planimetry: tuple[PlanimetricQuality, ...]
    assessed_at: datetime
    seconds: float
    software_version: str
    errors: MeasuredErrors = field(metadata=NOT_IN_JSON)
    statements: Statements = ()


@dataclass(frozen=True)
class BlockIdentification:
    """What a block says of itself, for its report.

    Attributes:
        id, version, title: of the block.
        created_at: when it was produced.
    """

    id: str
    version: str
    title: str
    created_at: datetime


def block_quality_report(
    block: BlockIdentification,
    points: ControlPoints,
    cells: BlockCells,
    requirements: BlockRequirements,
    measured: Measured,
    *,
    assessed_at: datetime,
    seconds: float,
    software_version: str,
) -> BlockQualityReport:
    """The report on the quality of a block."""
    images = images_per_point(points)
    figures = block_quality(points, images, measured.errors.outline)
    heights, planimetry = measured.heights, measured.planimetry
    criteria = block_criteria(requirements, cells, int(images.min()), heights, planimetry)
    verdict = block_verdict(criteria, requirements)
    ages = view_ages_years(points, assessed_at)
    known_ages = ages[np.isfinite(ages)]
    stated = produced_accuracy(points)
    return BlockQualityReport(
        format=BLOCK_QUALITY_FORMAT,
        block=AssessedBlock(
            block.id,
            block.version,
            block.title,
            block.created_at,
            points=len(points),
            images=len(np.unique(points.views.image)),
            area_km2=figures.area_km2,
            excluded_km2=max(0.0, figures.area_km2 - float(cells.density.area_km2.sum())),
        ),
        requirements=requirements,
        verdict=verdict,
        verdict_words=VERDICT_WORDS[verdict],
        criteria=criteria,
        places=tuple(_places(requirements, heights, planimetry)),
        relative_to_control_points=stated.relative_to_control_points,
        on_the_earth=stated.on_the_earth,
        density=_density(cells, requirements.points_per_km2),
        images_per_point=figures.images_per_point,
        views_per_point=figures.views_per_point,
        age_years=distribution(known_ages) if len(known_ages) else None,
        heights=heights,
        planimetry=planimetry,
        assessed_at=assessed_at,
        seconds=seconds,
        software_version=software_version,
        errors=measured.errors,
    )


def _density(cells: BlockCells, required: float | None) -> DensityQuality:
    density = cells.density
    n = len(density.points)
    missing = np.zeros(n, dtype=np.int64) if required is None else cells.missing_points(required)
    total_km2 = float(density.area_km2.sum())
    records = []
    for k in range(n):
        outcome: Literal["met", "missed"] = "missed" if missing[k] else "met"
        records.append(
            CellQuality(
                west=float(density.lon_lat[k, 0]),
                south=float(density.lon_lat[k, 1]),
                area_km2=float(density.area_km2[k]),
                excluded_km2=float(cells.excluded_km2[k]),
                points=int(density.points[k]),
                points_per_km2=float(density.points_per_km2[k]),
                missing_points=int(missing[k]),
                images=float(cells.images[k]),
                short_of_views=int(cells.short_of_views[k]),
                age_years=float(cells.age_years[k]),
                outcome="not specified" if required is None else outcome,
            )
        )
    nothing = float("nan")
    return DensityQuality(
        points_per_km2=float(density.points.sum()) / total_km2 if n else nothing,
        share_reaching_half=share_reaching(density, HALF_PER_KM2) if n else nothing,
        share_reaching_quarter=share_reaching(density, QUARTER_PER_KM2) if n else nothing,
        cells=tuple(records),
    )


def _places(
    requirements: BlockRequirements,
    heights: HeightQuality | None,
    planimetry: tuple[PlanimetricQuality, ...],
) -> Iterator[PlaceOutcome]:
    """Sites and cells of one degree, compared with the required accuracy."""
    if planimetry and requirements.ce90_m is not None:
        for site in planimetry[0].sites:
            measured, limit = site.accuracy.ce90_m, requirements.ce90_m
            outcome = outcome_of(measured, limit)
            yield PlaceOutcome(f"site {site.name}", "ce90_m", measured.value, limit, outcome)
    if heights is not None and requirements.le90_m is not None:
        for cell in heights.cells:
            measured, limit = cell.accuracy.le90_m, requirements.le90_m
            place, outcome = degree_words(cell.west, cell.south), outcome_of(measured, limit)
            yield PlaceOutcome(place, "le90_m", measured.value, limit, outcome)


def degree_words(west: float, south: float) -> str:
    """The name of a cell of one degree, by its south-western corner."""
    north_south = f"{abs(south):.0f}° {'N' if south >= 0 else 'S'}"
    return f"{north_south} {abs(west):.0f}° {'E' if west >= 0 else 'W'}"
