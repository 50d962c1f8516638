"""Select images from a catalogue: read it, call the science, write selection, cells and report."""

import time
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np
import shapely

from amers.app.usecases.registration.result_folder import replacing
from amers.app.usecases.report_files import write_report
from amers.services.formats.addresses import without_query
from amers.services.formats.stac.catalogue import StacCatalogue, parse_area, read_catalogue
from amers.services.formats.stac.writer import write_items
from amers.services.formats.text_files import load_json, read_text
from amers.services.formats.vector.cell_layers import write_cell_layer
from amers.services.production.image_selection import ImageSelection, SelectionOptions, select_images
from amers.services.reports.selection import (
    SelectionReport,
    SourceFacts,
    overlap_csv,
    selection_report,
)
from amers.services.reports.selection_pages import SELECTION_PAGE
from amers.services.types import Progress, no_progress, part_of

ITEMS, CELLS, OVERLAP = "selection.json", "cells.gpkg", "overlap.csv"
LIMIT_PROPERTY = "amers:cloud_limit_percent"
"""Property of a chosen item: the cloud limit that it needs."""


@dataclass(frozen=True)
class CatalogueRequest:
    """Which images of which catalogue.

    Attributes:
        source: path of a folder or a file, or address of an API.
        area: GeoJSON with the polygons that need views; None takes all footprints.
        since: images before are left out.
    """

    source: str
    area: Path | None = None
    since: datetime | None = None


def run_selection(
    request: CatalogueRequest,
    folder: Path,
    options: SelectionOptions = SelectionOptions(),
    progress: Progress = no_progress,
) -> SelectionReport:
    """Write the selected items, the cells of the ground and the report into a folder, or nothing.

    Args:
        request: which images.
        folder: of the result; an older result there is replaced as a whole.
        options: of the selection.
        progress: receives the fraction done and a message.

    Raises:
        InputError: the catalogue, the area or the folder cannot be used.
    """
    started = time.monotonic()
    with replacing(folder) as new:
        area = None
        if request.area is not None:
            area = parse_area(load_json(read_text(request.area), str(request.area)), str(request.area))
        box = None if area is None else shapely.bounds(area).tolist()
        catalogue = read_catalogue(request.source, box, request.since, part_of(progress, 0.0, 0.3))
        selection = select_images(catalogue.images, options, area, part_of(progress, 0.3, 0.6))
        progress(0.9, "files")
        report = selection_report(
            catalogue.images,
            selection,
            SourceFacts(
                without_query(request.source),
                catalogue.bad,
                catalogue.problems,
                catalogue.older,
                catalogue.other_masks,
            ),
            seconds=time.monotonic() - started,
            finished_at=datetime.now(UTC),
            software_version=version("amers"),
        )
        _write_files(new, catalogue, selection, report)
    progress(1.0, "done")
    return report


def _write_files(
    folder: Path, catalogue: StacCatalogue, selection: ImageSelection, report: SelectionReport
) -> None:
    limits = np.array(selection.options.cloud_limits_percent)
    items = catalogue.items.read(selection.image.tolist())
    chosen = zip(items, limits[selection.step].tolist(), strict=True)
    write_items(
        folder / ITEMS,
        (
            {**item, "properties": {**item["properties"], LIMIT_PROPERTY: limit}}
            for item, limit in chosen
        ),
    )
    cells = selection.cells
    write_cell_layer(
        folder / CELLS,
        "cells",
        cells.grid.boxes(cells.cell),
        {
            "clear_views": cells.views.astype(np.int64),
            "clear_views_available": cells.available.astype(np.int64),
            "missing_views": selection.missing,
            "cloud_limit_percent": limits[cells.step],
            "seasons": cells.seasons,
            "directions": cells.directions,
        },
    )
    (folder / OVERLAP).write_text(overlap_csv(report), encoding="utf-8")
    write_report(folder, SELECTION_PAGE, report)
