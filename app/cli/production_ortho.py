"""`amers production ortho`: a block from ortho-images and the heights of their ground."""

from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.output import AsJson, show_one
from amers.app.cli.production_rows import accuracy_row, agreement_row, sampling_pair
from amers.app.cli.progress import shown_progress
from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.ortho_production import OrthoFiles, run_ortho_production
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.production.image_production import ProductionOptions
from amers.services.production.ortho_production import OrthoPointOptions

_DEFAULT = ProductionOptions()
_ORTHO_DEFAULT = OrthoPointOptions()


def ortho(
    images: Annotated[
        list[Path],
        typer.Argument(
            exists=True,
            help="GeoTIFF (or COG) or JPEG 2000 on a map; several of one place, the most accurate "
            "first.",
        ),
    ],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder of the block.")],
    dem: Annotated[
        Path | None, typer.Option(exists=True, help="GeoTIFF with the heights of the ground.")
    ] = None,
    vertical: Annotated[
        str | None,
        typer.Option(help="Vertical datum of the heights: ellipsoid, EGM96, EGM2008, EPSG:…"),
    ] = None,
    geoid: Annotated[
        Path | None, typer.Option(exists=True, help="Grid file of the geoid, GTX or GeoTIFF.")
    ] = None,
    height_m: Annotated[
        float | None,
        typer.Option(help="Height of flat ground above the ellipsoid, metres; replaces --dem."),
    ] = None,
    height_sigma_m: Annotated[
        float | None,
        typer.Option(
            help="Sigma of the heights, metres; by default 0.1 of the terrain's step.", min=0.01
        ),
    ] = None,
    block_id: Annotated[
        str | None, typer.Option("--id", help="Id of the block; by default the folder's name.")
    ] = None,
    version: Annotated[str, typer.Option(help="Version of the block.")] = "1",
    title: Annotated[str, typer.Option(help="Title of the block.")] = "",
    license_name: Annotated[
        str, typer.Option("--license", help="Licence: SPDX identifier.")
    ] = "proprietary",
    gsd_m: Annotated[
        str | None,
        typer.Option(help="Ground sampling of the chips: FINE,COARSE, metres; by default the image's."),
    ] = None,
    points: Annotated[
        int, typer.Option(help="Desired number of points; --spacing-m overrides it.", min=6)
    ] = (_DEFAULT.points),
    spacing_m: Annotated[
        float | None, typer.Option(help="One point per square of this side, metres.", min=1.0)
    ] = None,
    sigma_m: Annotated[
        float | None,
        typer.Option(help="Accuracy of the images on the map, one sigma, metres.", min=0.01),
    ] = None,
    frame_sigma_up_m: Annotated[
        float | None,
        typer.Option(
            help="Error that all the heights share, one sigma, metres; by default unknown.", min=0.01
        ),
    ] = None,
    min_views: Annotated[
        int,
        typer.Option(
            help="Least number of images in which a point is found, of those showing it.", min=1
        ),
    ] = _ORTHO_DEFAULT.min_views,
    bands: Annotated[str | None, typer.Option(help="Bands to use: 2, or 1,2,3, or 3:0.3,2:0.7.")] = None,
    mask: Annotated[
        Path | None,
        typer.Option(exists=True, help="Image of the same ground; no points where it is not 0."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make control points with chips from ortho-images of one place and the heights of its ground."""
    fine_m, coarse_m = (None, None) if gsd_m is None else sampling_pair(gsd_m)
    options = OrthoPointOptions(
        fine_gsd_m=fine_m,
        coarse_gsd_m=coarse_m,
        spacing_m=spacing_m,
        points=points,
        min_views=min_views,
    )
    terrain = None if dem is None else TerrainFile(dem, vertical, geoid)
    files = OrthoFiles(
        tuple(images),
        terrain,
        height_m,
        height_sigma_m,
        sigma_m,
        frame_sigma_up_m,
        bands=bands,
        mask=mask,
    )
    identity = BlockIdentity(block_id or output.name, version, title, license_name)
    with shown_progress() as progress:
        production = run_ortho_production(files, output, identity, options, progress)
    show_one(
        {
            "block": output,
            "points": len(production.points),
            "views": int(production.points.views.start[-1]),
            "chip_gsds_m": list(production.gsds_m),
            **agreement_row(production.shift_m, production.local_sigma_m),
            **accuracy_row(production.points, as_json=as_json),
        },
        as_json=as_json,
    )
