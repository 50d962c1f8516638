"""The difference of two surfaces of one place, of two dates, written as a GeoTIFF."""

import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from amers.app.errors import InputError
from amers.app.usecases.report_files import write_texts
from amers.app.usecases.surface import reduced_map
from amers.services.datums import horizontal
from amers.services.errors import CoverageError
from amers.services.formats.images.ortho import BandForm, write_cog
from amers.services.formats.images.surfaces import open_surface
from amers.services.orthorectification.rectify import OrthoWindow
from amers.services.reports.html import format_html
from amers.services.reports.surface import DifferenceReport
from amers.services.reports.surface_pages import DIFFERENCE_PAGE
from amers.services.surface.difference import Alignment, DifferenceTile, TwoSurfaces
from amers.services.types import FloatImage, Progress, no_progress, part_of

DIFFERENCE_BANDS = ("difference_m", "sigma_m", "significance")
_CHANGED = 3.0
"""Differences of more sigmas are counted as changes: noise alone would give 3 in 1,000."""
_MOST_CELLS = 1_000_000
"""Cells that tell medians: all of small surfaces, a part of larger ones."""


@dataclass(frozen=True)
class SurfaceDifference:
    """A difference that was written.

    Attributes:
        path: of the GeoTIFF.
        report: page that shows it, beside it.
        crs: of its map.
        lines, samples: its size.
        gsd_m: side of a cell, metres.
        shift_m: x, y and height that were added to the later surface to bring it onto the earlier one.
        shift_sigma_m: one standard deviation of it, from how parts of the ground differ; 0 where it was
            not moved.
        aligned_cells: cells that agreed on this shift; 0 where none was asked for.
        moved_horizontally: False where none was asked for, or the ground is too flat to tell.
        known: share of the cells in which both surfaces have a height.
        median_m, nmad_m: of the differences.
        spread: of the differences in units of their sigma, by the median: 1 where the sigmas are honest
            and little has changed.
        changed: share of the known cells whose difference is larger than 3 sigmas.
    """

    path: Path
    report: Path
    crs: str
    lines: int
    samples: int
    gsd_m: float
    shift_m: tuple[float, ...]
    shift_sigma_m: tuple[float, ...]
    aligned_cells: int
    moved_horizontally: bool
    known: float
    median_m: float
    nmad_m: float
    spread: float
    changed: float


@dataclass
class _Differences:
    """What is counted of tiles on their way into the file."""

    step: int
    known: int = 0
    changed: int = 0
    thinned: list[FloatImage] = field(default_factory=list)

    def count(self, tiles: Iterator[DifferenceTile]) -> Iterator[OrthoWindow]:
        for tile in tiles:
            significance = tile.difference_m / tile.sigma_m
            found = np.isfinite(significance)
            self.known += int(found.sum())
            self.changed += int((np.abs(significance[found]) > _CHANGED).sum())
            both = np.stack([tile.difference_m, significance])[:, :: self.step, :: self.step]
            self.thinned.append(both[:, np.isfinite(both).all(axis=0)])
            bands = np.stack([tile.difference_m, tile.sigma_m, significance])
            yield OrthoWindow(tile.window, np.where(found, bands, np.nan).astype(np.float32), 0.0)
        if self.known == 0:
            raise CoverageError("the surfaces have no heights of the same ground")


def write_surface_difference(
    earlier: Path,
    later: Path,
    output: Path,
    *,
    align: bool = True,
    progress: Progress = no_progress,
) -> SurfaceDifference:
    """Write how much higher the later surface is, with the sigma of that and their ratio.

    Args:
        earlier, later: as `amers surface make` writes them.
        output: the GeoTIFF; an existing one is replaced when the new one is complete. A page that shows
            it, of the same name with the ending html, is written beside it.
        align: move the later surface onto the earlier one first, in position and height.
        progress: receives the fraction done and a message.

    Raises:
        InputError: a file cannot be used.
        CoverageError: the surfaces do not show the same ground.
    """
    if output.resolve() in (earlier.resolve(), later.resolve()):
        raise InputError(f"{output}: the output would replace a surface; choose another name")
    with ExitStack() as stack:
        pair = TwoSurfaces(*(stack.enter_context(open_surface(path)) for path in (earlier, later)))
        alignment = Alignment(np.zeros(3), np.zeros(3), 0, moved_horizontally=False)
        if align:
            alignment = pair.align(part_of(progress, 0.0, 0.6))
        grid = pair.grid
        lines, samples = grid.shape
        counted = _Differences(math.ceil(math.sqrt(lines * samples / _MOST_CELLS)))
        write_cog(
            output,
            grid,
            counted.count(pair.tiles(alignment.shift_m, part_of(progress, 0.6, 0.4))),
            BandForm(
                len(DIFFERENCE_BANDS),
                "float32",
                float("nan"),
                names=DIFFERENCE_BANDS,
                units=("metre", "metre", ""),
            ),
        )
    difference_m, significance = np.concatenate(counted.thinned, axis=1)
    median_m = float(np.median(difference_m))
    found = SurfaceDifference(
        output,
        output.with_suffix(".html"),
        grid.crs,
        lines,
        samples,
        float(grid.step_xy[0, 1]),
        tuple(round(float(value), 3) for value in alignment.shift_m),
        tuple(round(float(value), 3) for value in alignment.sigma_m),
        alignment.cells,
        alignment.moved_horizontally,
        counted.known / (lines * samples),
        median_m,
        1.4826 * float(np.median(np.abs(difference_m - median_m))),
        1.4826 * float(np.median(np.abs(significance))),
        counted.changed / counted.known,
    )
    _write_report(found, earlier.name, later.name)
    return found


def _write_report(found: SurfaceDifference, earlier: str, later: str) -> None:
    report = DifferenceReport(
        reduced_map(found.path, (found.lines, found.samples), found.gsd_m),
        horizontal(found.crs).name,
        earlier,
        later,
        found.shift_m,
        found.shift_sigma_m,
        found.aligned_cells,
        found.moved_horizontally,
        found.known,
        found.median_m,
        found.nmad_m,
        found.spread,
        found.changed,
        datetime.now(UTC),
        version("amers"),
    )
    write_texts(found.report.parent, {found.report.name: format_html(DIFFERENCE_PAGE, report)})
