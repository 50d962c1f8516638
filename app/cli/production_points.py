"""`amers production points`: a block of the points of another base, with their chips or from images."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.options import GeoidFile, Places, Shown, refuse_alone
from amers.app.cli.output import AsJson, show_one
from amers.app.cli.point_statements import sigma_pair, stated_by_caller
from amers.app.cli.production_rows import accuracy_row, agreement_row, sampling_pair
from amers.app.cli.progress import shown_progress
from amers.app.usecases.model_choice import ModelChoice
from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.points_production import KnownPointFiles, run_points_production
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.pieces import source_of
from amers.services.production.points_production import KnownPointOptions

Files = Annotated[
    KnownPointFiles,
    Shown(
        points=typer.Argument(exists=True),
        images=None,
        chips=typer.Option(),
        chip_origin=None,
        bands=None,
        sigma_m=typer.Option(min=0.01),
        height_sigma_m=typer.Option(min=0.01),
        frame_sigma_m=typer.Option(min=0.001),
        frame_sigma_up_m=typer.Option(min=0.001),
    ),
]


@dataclass(frozen=True)
class StatementOptions:
    """What the file of the points does not state.

    Attributes:
        vertical: vertical datum of the points: ellipsoid, EGM96, EGM2008, EPSG:…
        geoid: grid file of the geoid of the points, GTX or GeoTIFF.
        crs: reference system of x and y of a CSV, such as EPSG:32633.
        columns: names of the columns of a CSV, if they differ from the usual ones:
            lon=COLUMN,lat=COLUMN,…
        sigma_axes: axes of the sigmas of an ASP file: ecef or lat-lon-height.
        point_sigma_m: accuracy of the points if their file states none: HORIZONTAL,UP, one sigma,
            metres.
        dem: heights for points without heights: a file, or a folder or .txt list of tiles.
        dem_vertical: vertical datum of --dem.
        dem_geoid: grid file of the geoid of --dem.
    """

    vertical: str | None = None
    geoid: GeoidFile = None
    crs: str | None = None
    columns: str | None = None
    sigma_axes: str | None = None
    point_sigma_m: str | None = None
    dem: Places = ()
    dem_vertical: str | None = None
    dem_geoid: GeoidFile = None

    @property
    def terrain(self) -> TerrainFile | None:
        """The heights of points without any; None without --dem.

        Raises:
            InputError: an option belongs to --dem, which is not given.
        """
        refuse_alone("dem", self, "dem_vertical", "dem_geoid")
        if not self.dem:
            return None
        return TerrainFile(
            source_of(self.dem), self.dem_vertical, self.dem_geoid, geoid_option="--dem-geoid"
        )


def points(
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder of the block.")],
    files: Files,
    models: ModelChoice,
    stated: StatementOptions,
    identity: BlockIdentity,
    gsd_m: Annotated[
        str | None,
        typer.Option(
            help="Ground sampling of the chips: FINE,COARSE, metres; by default the ground "
            "sampling of the images."
        ),
    ] = None,
    options: Annotated[KnownPointOptions, Shown(min_views=typer.Option(min=1))],
    as_json: AsJson = False,
) -> None:
    """Make a block from the points of another base, with chips of that base or from your images."""
    if gsd_m is not None:
        fine_m, coarse_m = sampling_pair(gsd_m)
        options = replace(options, fine_gsd_m=fine_m, coarse_gsd_m=coarse_m)
    files = replace(
        files,
        stated=stated_by_caller(
            stated.geoid or stated.vertical, stated.crs, stated.columns, stated.sigma_axes
        ),
        point_sigma_m=sigma_pair(stated.point_sigma_m, "--point-sigma-m"),
        terrain=stated.terrain,
        models=models,
    )
    identity = identity.named_after(output)
    with shown_progress() as progress:
        production = run_points_production(files, output, identity, options, progress)
    left_out = production.left_out
    show_one(
        {
            "block": output,
            "points": len(production.points),
            "views": int(production.points.views.start[-1]),
            "chip_gsds_m": list(production.gsds_m),
            **(
                {"left_out": left_out}
                if as_json
                else {f"left out: {why}": n for why, n in left_out.items()}
            ),
            **agreement_row(production.shift_m, production.local_sigma_m),
            **accuracy_row(production.points, as_json=as_json),
            "statements": production.statements,
        },
        as_json=as_json,
    )
