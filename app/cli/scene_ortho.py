"""`amers scene ortho`: a scene as an ortho-image."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.output import AsJson, show_one
from amers.app.cli.progress import shown_progress
from amers.app.errors import InputError
from amers.app.usecases.orthorectification import OrthoMap, run_orthorectification
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.orthorectification.rectify import OrthoOptions


def ortho(
    scene: Annotated[Path, typer.Argument(exists=True, help="GeoTIFF, JPEG 2000 or NITF.")],
    *,
    dem: Annotated[Path, typer.Option(exists=True, help="GeoTIFF with the heights of the ground.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="GeoTIFF to write.")],
    model: Annotated[
        Path | None,
        typer.Option(
            exists=True, help="File of the model, such as a refined one; by default found by its name."
        ),
    ] = None,
    vertical: Annotated[
        str | None,
        typer.Option(help="Vertical datum of the heights: ellipsoid, EGM96, EGM2008, EPSG:…"),
    ] = None,
    geoid: Annotated[
        Path | None, typer.Option(exists=True, help="Grid file of the geoid, GTX or GeoTIFF.")
    ] = None,
    fill_px: Annotated[
        int, typer.Option(help="Fill voids of the terrain from this many nodes away.", min=0, max=50)
    ] = 0,
    crs: Annotated[
        str | None,
        typer.Option(help="Coordinate reference system of the map; by default the UTM zone."),
    ] = None,
    gsd_m: Annotated[
        float | None,
        typer.Option(help="Ground sampling, metres; by default that of the scene.", min=0.001),
    ] = None,
    kernel: Annotated[str, typer.Option(help="Interpolation: cubic or bilinear.")] = "cubic",
    tolerance_px: Annotated[
        float, typer.Option(help="Largest allowed error of the mapping, pixels.", min=1e-4)
    ] = 0.1,
    hide: Annotated[
        bool, typer.Option("--hide", help="Leave out ground that other ground hides from the sensor.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Orthorectify a scene through its model and a terrain into a cloud-optimised GeoTIFF."""
    if kernel not in ("cubic", "bilinear"):
        raise InputError(f"--kernel: {kernel} found, cubic or bilinear expected")
    with shown_progress() as progress:
        orthorectified = run_orthorectification(
            scene,
            TerrainFile(dem, vertical, geoid, fill_px),
            output,
            model=model,
            ortho_map=OrthoMap(crs, gsd_m),
            options=OrthoOptions("cubic" if kernel == "cubic" else "bilinear", tolerance_px, hide),
            progress=progress,
        )
    show_one(asdict(orthorectified), as_json=as_json)
