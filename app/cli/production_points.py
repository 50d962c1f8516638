"""`amers production points`: a block of the points of another base, with their chips or from images."""

from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.output import AsJson, show_one
from amers.app.cli.point_statements import sigma_pair, stated_by_caller
from amers.app.cli.production_rows import accuracy_row, agreement_row, sampling_pair
from amers.app.cli.progress import shown_progress
from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.points_production import KnownPointFiles, run_points_production
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.gcp.csv_points import PIXEL_ORIGINS
from amers.services.formats.gcp.text_formats import ECEF, LAT_LON_HEIGHT
from amers.services.production.points_production import KnownPointOptions

_DEFAULT = KnownPointOptions()


def points(
    file: Annotated[
        Path,
        typer.Argument(
            exists=True,
            help="Points: GCPLib, Copernicus GCP database, CSV, ASP, OPF, GeoJSON, ODM, QGIS, ENVI, "
            "PCI.",
        ),
    ],
    *,
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder of the block.")],
    images: Annotated[
        list[Path] | None,
        typer.Option(
            "--images",
            exists=True,
            help="Image with a registered model, or on a map; repeat, the most accurate first.",
        ),
    ] = None,
    chips: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the base's own chips, in place of images: GCPLib, Copernicus GCP database.",
        ),
    ] = None,
    chip_origin: Annotated[
        str | None,
        typer.Option(help=f"Origin of the pixels of GCPLib's chips: {', '.join(PIXEL_ORIGINS)}."),
    ] = None,
    vertical: Annotated[
        str | None,
        typer.Option(help="Vertical datum of the points: ellipsoid, EGM96, EGM2008, EPSG:…"),
    ] = None,
    geoid: Annotated[
        Path | None, typer.Option(exists=True, help="Grid file of the points' geoid, GTX or GeoTIFF.")
    ] = None,
    crs: Annotated[
        str | None, typer.Option(help="Reference system of x and y of a CSV, such as EPSG:32633.")
    ] = None,
    columns: Annotated[
        str | None, typer.Option(help="Columns of a CSV of other names: lon=COLUMN,lat=COLUMN,…")
    ] = None,
    sigma_axes: Annotated[
        str | None,
        typer.Option(help=f"Axes of the sigmas of an ASP file: {ECEF} or {LAT_LON_HEIGHT}."),
    ] = None,
    point_sigma_m: Annotated[
        str | None,
        typer.Option(
            help="Accuracy of points whose file states none: HORIZONTAL,UP, one sigma, metres."
        ),
    ] = None,
    dem: Annotated[
        Path | None, typer.Option(exists=True, help="GeoTIFF with the heights of points without any.")
    ] = None,
    dem_vertical: Annotated[str | None, typer.Option(help="Vertical datum of --dem.")] = None,
    dem_geoid: Annotated[
        Path | None, typer.Option(exists=True, help="Grid file of the geoid of --dem.")
    ] = None,
    height_sigma_m: Annotated[
        float | None,
        typer.Option(
            help="Sigma of the heights of --dem, metres; by default 0.1 of its step.", min=0.01
        ),
    ] = None,
    sigma_m: Annotated[
        float | None,
        typer.Option(help="Accuracy of the images' models, one sigma, metres.", min=0.01),
    ] = None,
    frame_sigma_m: Annotated[
        float | None,
        typer.Option(
            help="Error that all points share, horizontal, one sigma, metres; by default unknown.",
            min=0.001,
        ),
    ] = None,
    frame_sigma_up_m: Annotated[
        float | None, typer.Option(help="The same of their heights.", min=0.001)
    ] = None,
    gsd_m: Annotated[
        str | None,
        typer.Option(help="Ground sampling of the chips: FINE,COARSE, metres; by default the images'."),
    ] = None,
    min_views: Annotated[
        int,
        typer.Option(
            help="Least number of images in which a point is found, of those showing it.", min=1
        ),
    ] = _DEFAULT.min_views,
    bands: Annotated[str | None, typer.Option(help="Bands to use: 2, or 1,2,3, or 3:0.3,2:0.7.")] = None,
    block_id: Annotated[
        str | None, typer.Option("--id", help="Id of the block; by default the folder's name.")
    ] = None,
    version: Annotated[str, typer.Option(help="Version of the block.")] = "1",
    title: Annotated[str, typer.Option(help="Title of the block.")] = "",
    license_name: Annotated[
        str, typer.Option("--license", help="Licence: SPDX identifier.")
    ] = "proprietary",
    as_json: AsJson = False,
) -> None:
    """Make a block of the points of another base, with its own chips or from images that show them."""
    fine_m, coarse_m = (None, None) if gsd_m is None else sampling_pair(gsd_m)
    files = KnownPointFiles(
        points=file,
        images=tuple(images or ()),
        chips=chips,
        chip_origin=chip_origin,
        stated=stated_by_caller(geoid or vertical, crs, columns, sigma_axes),
        point_sigma_m=sigma_pair(point_sigma_m, "--point-sigma-m"),
        terrain=None
        if dem is None
        else TerrainFile(dem, dem_vertical, dem_geoid, geoid_option="--dem-geoid"),
        height_sigma_m=height_sigma_m,
        sigma_m=sigma_m,
        frame_sigma_m=frame_sigma_m,
        frame_sigma_up_m=frame_sigma_up_m,
        bands=bands,
    )
    options = KnownPointOptions(fine_gsd_m=fine_m, coarse_gsd_m=coarse_m, min_views=min_views)
    identity = BlockIdentity(block_id or output.name, version, title, license_name)
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
        },
        as_json=as_json,
    )
