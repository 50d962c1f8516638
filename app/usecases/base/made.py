"""A base that was made, what it took, and its report."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np
import shapely

from amers.app.usecases.base.tile_points import PlacedDates
from amers.app.usecases.registration.result_folder import replacing
from amers.app.usecases.report_files import write_report
from amers.services.imagery.archives import Archive
from amers.services.quality.block import produced_accuracy
from amers.services.reports.base import BaseReport, Costs, ImageRow
from amers.services.reports.base_pages import BASE_PAGE
from amers.services.tasks import Effort
from amers.services.types import ControlPoints


@dataclass(frozen=True)
class MadeBase:
    """A base, and what it took.

    Attributes:
        points: of the block.
        placed: its images, and the frames of their dates.
        area_km2: of the region.
        left_out: words for images that were chosen and not used.
        bytes: read at addresses by this command.
        pixels, full_pixels: read, and of the whole images.
        local_sigma_m: of details; NaN when unknown.
        clear: clear shares of the region by the ids of images, 0 to 1.
        attribution: of the data.
        effort: of the tasks, by their stage.
    """

    points: ControlPoints
    placed: PlacedDates
    area_km2: float
    left_out: list[str]
    bytes: int
    pixels: int
    full_pixels: int
    local_sigma_m: float
    clear: dict[str, float]
    attribution: str
    effort: dict[str, Effort]

    @property
    def cpu_s(self) -> float:
        """Seconds of a core that all tasks took."""
        return sum(one.cpu_s for one in self.effort.values())

    @property
    def images(self) -> int:
        """Number of images."""
        return sum(len(tile.images) for tile in self.placed.tiles)


@dataclass(frozen=True)
class BaseSource:
    """What a base was made of.

    Attributes:
        area: the region.
        archive: of the images.
        catalogues: that were contacted, without signatures.
        unused_items: number of their items that cannot be used.
    """

    area: shapely.Geometry
    archive: Archive
    catalogues: tuple[str, ...]
    unused_items: int


def report_folder(block: Path) -> Path:
    """The folder of the report of a base, beside its block."""
    return block.with_name(f"{block.name}.report")


def write_base_report(block: Path, name: str, made: MadeBase, source: BaseSource) -> None:
    """Write the report of a base into a folder of its own: a block holds nothing else than a block.

    Args:
        block: folder of the block.
        name: of the block.
        made: what was made.
        source: of what.
    """
    points, frames = made.points, made.placed.frames
    of_view = np.repeat(np.arange(len(points)), np.diff(points.views.start))
    seen = np.unique(np.column_stack([of_view, points.views.image]), axis=0)
    shown = np.bincount(seen[:, 1], minlength=len(points.views.images))
    counts = {one.image_id: int(n) for one, n in zip(points.views.images, shown, strict=True)}
    report = BaseReport(
        block=name,
        archive=source.archive.name,
        area_km2=made.area_km2,
        outlines=tuple(np.array(part.exterior.coords)[:, :2] for part in shapely.get_parts(source.area)),
        lon_lat_h=points.lon_lat_h,
        dates_of_points=np.bincount(seen[:, 0], minlength=len(points)).astype(np.int64),
        images=_image_rows(made, counts),
        left_out=tuple(made.left_out),
        unused_items=source.unused_items,
        frames=frames,
        date_names=tuple(made.placed.dates),
        accuracy=produced_accuracy(points),
        costs=Costs(
            made.bytes,
            made.bytes / made.area_km2,
            made.pixels / max(1, made.full_pixels),
            made.cpu_s / len(points),
        ),
        attribution=made.attribution,
        terms=source.archive.terms,
        catalogues=source.catalogues,
        finished_at=datetime.now(UTC),
        software_version=version("amers"),
    )
    with replacing(report_folder(block)) as new:
        write_report(new, BASE_PAGE, report)


def _image_rows(made: MadeBase, counts: Mapping[str, int]) -> tuple[ImageRow, ...]:
    placed = made.placed
    return tuple(
        ImageRow(
            image.id,
            tile.area.tile,
            image.date,
            image.orbit,
            100.0 * made.clear[image.id],
            placed.frames.error_m[placed.dates.index(image.date)],
            image.accuracy.total_m,
            counts.get(image.id, 0),
        )
        for tile in placed.tiles
        for image in tile.images
    )
