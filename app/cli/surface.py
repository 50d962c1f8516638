"""`amers surface`: the surface that overlapping scenes show, its points, and what changed."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.image_production import WorkOptions
from amers.app.cli.options import Shown
from amers.app.cli.output import AsJson, Row, show_one
from amers.app.cli.production_rows import effort_row
from amers.app.cli.progress import shown_progress
from amers.app.errors import InputError
from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.surface import SurfaceFiles, run_surface
from amers.app.usecases.surface_difference import SurfaceDifference, write_surface_difference
from amers.app.usecases.surface_points import write_surface_points
from amers.services.surface.options import MOST_FILL_CELLS, SurfaceOptions

Files = Annotated[
    SurfaceFiles,
    Shown(
        images=typer.Argument(exists=True),
        registered=None,
        block=None,
        water=typer.Option(exists=True),
    ),
]


@dataclass(frozen=True)
class MadeOptions:
    """How the surface is made.

    Attributes:
        gsd_m: side of a cell, metres; by default the ground sampling of the finest image, rounded to two
            digits.
        heights_m: lowest and highest height of the surface above the ellipsoid: LOW,HIGH, metres; by
            default the height range of the sensor models.
        pairs: largest number of image pairs that are matched.
        fill_cells: fill gaps from heights at most this many cells away; 0 leaves gaps open.
    """

    gsd_m: Annotated[float | None, typer.Option(min=0.01)] = None
    heights_m: str | None = None
    pairs: Annotated[int, typer.Option(min=1)] = 10
    fill_cells: Annotated[int, typer.Option(min=0, max=MOST_FILL_CELLS)] = MOST_FILL_CELLS

    def options(self) -> SurfaceOptions:
        """The same as the service takes it.

        Raises:
            InputError: the heights are not two numbers in their order.
        """
        heights_m = None if self.heights_m is None else _range(self.heights_m)
        return SurfaceOptions(self.gsd_m, heights_m, self.pairs, fill_cells=self.fill_cells)


def make(
    *,
    files: Files,
    output: Annotated[Path, typer.Option("-o", "--output", help="GeoTIFF to write.")],
    made: MadeOptions,
    place: WorkOptions,
    as_json: AsJson = False,
) -> None:
    """Make the surface that overlapping registered scenes show: heights with their accuracy, on a map.

    The file has four bands: height above the ellipsoid and its standard deviation in metres, the number
    of images, and a code for the reason if a cell has no height. A page with the ending html shows the
    result. The models of the scenes must agree: register the scenes together first (--registered), or
    give the block that was made from them (--block).
    """
    with shown_progress() as progress:
        surface = run_surface(
            files,
            output,
            made.options(),
            place=WorkPlace(place.work, ComputeOptions(place.jobs, place.cluster)),
            progress=progress,
        )
    record = asdict(surface)
    record |= effort_row(surface.effort, as_json=as_json)
    record.pop("effort")
    if not as_json:
        record["pairs"] = [
            f"{' + '.join(pair['images'])} (B/H {pair['base_to_height']:.2f}, sigma "
            f"{pair['sigma_m']:.2f} m)"
            for pair in surface.pairs
        ]
        record["cells"] = [f"{label}: {count:,}" for label, count in surface.cells.items()]
    show_one(record, as_json=as_json)


def points(
    surface: Annotated[
        Path, typer.Argument(exists=True, help="Surface, as `amers surface make` writes it.")
    ],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="LAZ or LAS file to write.")],
    max_sigma_m: Annotated[
        float | None,
        typer.Option(min=0.0, help="Leave out cells with a larger standard deviation, metres."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write the cells of a surface as a point cloud, for CloudCompare and QGIS.

    Heights are above the ellipsoid, as the reference system in the file states. Every point has its
    standard deviation (sigma_m) and the number of images that show it (views; 0 for a filled height).
    """
    with shown_progress() as progress:
        cloud = write_surface_points(surface, output, max_sigma_m=max_sigma_m, progress=progress)
    show_one(asdict(cloud), as_json=as_json)


def difference(
    earlier: Annotated[
        Path, typer.Argument(exists=True, help="Surface, as `amers surface make` writes it.")
    ],
    later: Annotated[
        Path,
        typer.Argument(
            exists=True, help="Surface of the later date, as `amers surface make` writes it."
        ),
    ],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="GeoTIFF to write.")],
    align: Annotated[
        bool,
        typer.Option(
            help="Shift the later surface onto the earlier one in position and height before "
            "they are compared."
        ),
    ] = True,
    as_json: AsJson = False,
) -> None:
    """Compare two surfaces: what rose and what sank, with its accuracy, on a map.

    The file has three bands: height of the later surface above the earlier one, the standard deviation
    of this difference, and their ratio. A page with the ending html shows the result. The command
    removes the shift of the later surface with which both agree on most of the ground, and prints it.
    With --no-align, the shift stays, and a common error of all heights appears as a difference.
    """
    with shown_progress() as progress:
        found = write_surface_difference(earlier, later, output, align=align, progress=progress)
    show_one(asdict(found) if as_json else _difference_row(found), as_json=as_json)


def _difference_row(found: SurfaceDifference) -> Row:
    """A difference for people, with axes and units."""
    row = asdict(found)
    words = {
        "shift in x, y, height (m)": row.pop("shift_m"),
        "sigma of the shift in x, y, height (m)": row.pop("shift_sigma_m"),
        "aligned_cells": row.pop("aligned_cells"),
        "moved_horizontally": "yes" if row.pop("moved_horizontally") else "no",
        "cells with both heights (%)": 100.0 * row.pop("known"),
        "median of the differences (m)": row.pop("median_m"),
        "NMAD of the differences (m)": row.pop("nmad_m"),
        "spread of the differences (sigmas)": row.pop("spread"),
        "cells that changed by more than 3 sigmas (%)": 100.0 * row.pop("changed"),
    }
    return row | words


def _range(text: str) -> tuple[float, float]:
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--heights-m: {text} found, LOW,HIGH in metres expected") from None
    if not low < high:
        raise InputError(f"--heights-m: {text} found, the lower height first expected")
    return low, high
