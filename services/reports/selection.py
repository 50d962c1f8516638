"""Content of the report on a selection of images."""

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from amers.services.imagery.catalogue import ImageCatalogue
from amers.services.production.image_selection import ImageSelection, ImageUse, SelectionOptions

FORMAT = "amers-selection/1"
COMPLETE, RELAXED, SHORT = "complete", "relaxed", "short"
_LISTED_VIEWS = 2
"""The table of overlap lists views up to this many times those that every place needs."""


@dataclass(frozen=True)
class SourceFacts:
    """What was read of a catalogue.

    Attributes:
        name: path or address.
        bad: items that cannot be used.
        problems: words for the first of them.
        older: items before the first time asked for.
        other_masks: masks in formats that are not read.
    """

    name: str
    bad: int
    problems: tuple[str, ...]
    older: int
    other_masks: int


@dataclass(frozen=True)
class LimitRow:
    """A cloud limit: the chosen images that need it, and the ground where it holds.

    Attributes:
        below_percent: the limit.
        images: chosen images below it, and not below the one before.
        area_km2: of the ground where it holds.
        share: of all ground.
    """

    below_percent: float
    images: int
    area_km2: float
    share: float


@dataclass(frozen=True)
class OverlapRow:
    """A number of clear views: how much ground has it.

    Attributes:
        views: clear views; the last row stands for more, too.
        area_km2, share: of the ground that has them by the chosen images.
        share_available: of the ground that has them by all usable images.
    """

    views: int
    area_km2: float
    share: float
    share_available: float


@dataclass(frozen=True)
class SelectionReport:
    """The report on a selection of images.

    Attributes:
        source: what was read.
        options: of the selection.
        verdict: complete, relaxed or short.
        area_km2: of all ground.
        cells: number of cells.
        cell_km: their side.
        use: of the images.
        bound: number of images that no selection falls below that gives as many views.
        above_bound: chosen images above the bound, as a share of it.
        limits: by cloud limit.
        overlap: by number of views.
        short: by number of missing views; `views` is that number.
        mean_views, largest_views: clear views of a cell by the chosen images.
        mean_seasons, mean_directions: of the cells that have enough views; None where none has.
        acquired: first, middle and last time of the chosen images.
        seconds: that the selection took.
        finished_at: UTC.
        software_version: of Amers.
        selection: that the maps draw; not part of the document.
    """

    source: SourceFacts
    options: SelectionOptions
    verdict: str
    area_km2: float
    cells: int
    cell_km: float
    use: ImageUse
    bound: int
    above_bound: float
    limits: tuple[LimitRow, ...]
    overlap: tuple[OverlapRow, ...]
    short: tuple[OverlapRow, ...]
    mean_views: float
    largest_views: int
    mean_seasons: float | None
    mean_directions: float | None
    acquired: tuple[datetime, ...]
    seconds: float
    finished_at: datetime
    software_version: str
    selection: ImageSelection

    @property
    def share_short(self) -> float:
        """Share of the ground with too few views."""
        return sum(row.share for row in self.short)

    @property
    def share_relaxed(self) -> float:
        """Share of the ground where more clouds are allowed."""
        return sum(row.share for row in self.limits[1:])

    @property
    def verdict_words(self) -> str:
        """The verdict as a sentence."""
        needed = self.options.min_views
        first = self.options.cloud_limits_percent[0]
        if self.verdict == COMPLETE:
            return f"All ground has {needed} clear views by images with less than {first:g} % cloud."
        relaxed = (
            f"More than {first:g} % cloud is allowed for {share_words(self.share_relaxed)} of the ground"
        )
        if self.verdict == RELAXED:
            return f"All ground has {needed} clear views. {relaxed}."
        missing = f"{share_words(self.share_short)} of the ground has fewer than {needed} clear views"
        return f"{missing}: the catalogue has no more. {relaxed}."

    def document(self) -> dict[str, Any]:
        """Members of the JSON document."""
        times = ("first", "middle", "last")
        return {
            "format": FORMAT,
            "catalogue": self.source.name,
            "verdict": self.verdict,
            "verdict_words": self.verdict_words,
            **{
                name: value
                for name, value in vars(self).items()
                if name not in ("acquired", "selection")
            },
            "acquired": dict(zip(times, self.acquired, strict=False)),
        }


def selection_report(
    catalogue: ImageCatalogue,
    selection: ImageSelection,
    source: SourceFacts,
    *,
    seconds: float,
    finished_at: datetime,
    software_version: str,
) -> SelectionReport:
    """The report on a selection from a catalogue."""
    cells, options = selection.cells, selection.options
    area = cells.grid.area_km2(cells.cell)
    total = float(area.sum())
    missing = selection.missing
    most = _LISTED_VIEWS * options.min_views
    views, available = np.minimum(cells.views, most), np.minimum(cells.available, most)

    def rows(of: np.ndarray, other: np.ndarray, numbers: range) -> tuple[OverlapRow, ...]:
        sums = (float(area[of == number].sum()) for number in numbers)
        others = (float(area[other == number].sum()) for number in numbers)
        pairs = zip(numbers, sums, others, strict=True)
        return tuple(OverlapRow(k, one, one / total, two / total) for k, one, two in pairs)

    limits = tuple(
        LimitRow(
            below_percent=limit,
            images=int((selection.step == step).sum()),
            area_km2=float(area[cells.step == step].sum()),
            share=float(area[cells.step == step].sum()) / total,
        )
        for step, limit in enumerate(options.cloud_limits_percent)
    )
    has_enough = missing == 0
    times = np.sort(catalogue.acquired[selection.image])
    picked = times[[0, len(times) // 2, -1]] if len(times) else times
    return SelectionReport(
        source=source,
        options=options,
        verdict=SHORT if not has_enough.all() else RELAXED if (cells.step > 0).any() else COMPLETE,
        area_km2=total,
        cells=len(area),
        cell_km=float(np.sqrt(np.median(area))),
        use=selection.use,
        bound=int(np.ceil(selection.bound.images - 1e-6)),
        above_bound=selection.above_bound,
        limits=limits,
        overlap=rows(views, available, range(most + 1)),
        short=rows(
            missing, np.maximum(0, options.min_views - cells.available), range(1, options.min_views + 1)
        ),
        mean_views=float((cells.views * area).sum() / total),
        largest_views=int(cells.views.max()),
        mean_seasons=float(cells.seasons[has_enough].mean()) if has_enough.any() else None,
        mean_directions=float(cells.directions[has_enough].mean()) if has_enough.any() else None,
        acquired=tuple(moment.item().replace(tzinfo=UTC) for moment in picked),
        seconds=seconds,
        finished_at=finished_at,
        software_version=software_version,
        selection=selection,
    )


def overlap_csv(report: SelectionReport) -> str:
    """The table of overlap as CSV."""
    lines = ["clear_views,area_km2,share_percent,share_of_catalogue_percent"]
    for row in report.overlap:
        shares = f"{100.0 * row.share:.4f},{100.0 * row.share_available:.4f}"
        lines.append(f"{views_words(row, report)},{row.area_km2:.1f},{shares}")
    return "\n".join(lines) + "\n"


def views_words(row: OverlapRow, report: SelectionReport) -> str:
    """The number of views of a row of the overlap; the last stands for more."""
    return f"{row.views}+" if row is report.overlap[-1] else str(row.views)


def share_words(share: float) -> str:
    """A share in percent; shares that are not zero never look like it."""
    percent = 100.0 * share
    return "less than 0.1 %" if 0.0 < percent < 0.05 else f"{percent:.1f} %"
