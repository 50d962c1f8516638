"""`amers production run`: make a block from overlapping images, given or chosen from a catalogue."""

import os
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from amers.app.cli import control_options
from amers.app.cli.output import AsJson, show_one
from amers.app.cli.production_rows import accuracy_row, control_row, effort_row, sampling_pair
from amers.app.cli.progress import shown_progress
from amers.app.errors import InputError
from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.ground_classes import GroundFiles
from amers.app.usecases.image_production import ProductionImages, WorkPlace, run_image_production
from amers.app.usecases.image_selection import CatalogueRequest, run_selection
from amers.app.usecases.new_block import BlockIdentity, refuse_existing
from amers.services.formats.addresses import file_place
from amers.services.production.image_production import ProductionOptions
from amers.services.reports.block_adjustment_pages import adjustment_table
from amers.services.types import part_of

_DEFAULT = ProductionOptions()
_SHARE_OF_SELECTION = 0.05
_TABLE_WIDTH = 140


def run(
    *,
    images: Annotated[
        list[str] | None,
        typer.Option(
            "--images",
            help="Image with its model: a path, s3://BUCKET/KEY or https://…; repeat for every image.",
        ),
    ] = None,
    catalogue: Annotated[
        str | None,
        typer.Option(
            help="STAC catalogue to choose images from, a path or an address; the selection stays in "
            "OUTPUT.selection."
        ),
    ] = None,
    selection: Annotated[
        Path | None, typer.Option(exists=True, help="Folder that `amers production select` has written.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder of the block.")],
    block_id: Annotated[
        str | None, typer.Option("--id", help="Id of the block; by default the folder's name.")
    ] = None,
    version: Annotated[str, typer.Option(help="Version of the block.")] = "1",
    title: Annotated[str, typer.Option(help="Title of the block.")] = "",
    license_name: Annotated[
        str, typer.Option("--license", help="Licence: SPDX identifier.")
    ] = "proprietary",
    gsd_m: Annotated[str, typer.Option(help="Ground sampling of the chips: FINE,COARSE, metres.")] = (
        f"{_DEFAULT.fine_gsd_m:g},{_DEFAULT.coarse_gsd_m:g}"
    ),
    points: Annotated[
        int, typer.Option(help="Desired number of points; --spacing-m overrides it.", min=6)
    ] = (_DEFAULT.points),
    spacing_m: Annotated[
        float | None, typer.Option(help="One point per square of this side, metres.", min=1.0)
    ] = None,
    min_views: Annotated[
        int, typer.Option(help="Least number of images that see a point.", min=2)
    ] = _DEFAULT.min_views,
    sigma_m: Annotated[
        float | None, typer.Option(help="Accuracy of the models, one sigma, metres.", min=0.01)
    ] = None,
    control: control_options.Control = None,
    control_sigma_m: control_options.SigmaM = None,
    control_frame_sigma_m: control_options.FrameSigmaM = None,
    control_mark_sigma_px: control_options.MarkSigmaPx = None,
    control_vertical: control_options.Vertical = None,
    control_geoid: control_options.Geoid = None,
    control_crs: control_options.Crs = None,
    control_columns: control_options.Columns = None,
    control_sigma_axes: control_options.SigmaAxes = None,
    neighbour: control_options.Neighbour = None,
    control_ortho: control_options.Ortho = None,
    control_ortho_sigma_m: control_options.OrthoSigmaM = None,
    control_dem: control_options.Dem = None,
    control_dem_vertical: control_options.DemVertical = None,
    control_dem_geoid: control_options.DemGeoid = None,
    control_dem_sigma_m: control_options.DemSigmaM = None,
    control_dem_frame_sigma_m: control_options.DemFrameSigmaM = None,
    exclude: Annotated[
        list[Path] | None,
        typer.Option(
            exists=True,
            help="Ground without points: GeoJSON polygons, or an image on a map; repeat for several.",
        ),
    ] = None,
    land_cover: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            help="Image of land cover classes: the typology of the points; water, snow and ice get "
            "none.",
        ),
    ] = None,
    area: Annotated[
        Path | None, typer.Option(exists=True, help="GeoJSON of the ground to see, for --catalogue.")
    ] = None,
    since: Annotated[
        datetime | None,
        typer.Option(help="Leave out images of --catalogue before this day.", formats=["%Y-%m-%d"]),
    ] = None,
    work: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            help="Folder of intermediate results, which is kept; by default OUTPUT.work, until the "
            "block is complete. An interrupted production goes on from there.",
        ),
    ] = None,
    jobs: Annotated[
        int, typer.Option(help="Processes on this machine.", min=1, max=1024)
    ] = os.cpu_count() or 1,
    cluster: Annotated[
        str | None, typer.Option(help="Address of a Dask cluster's scheduler: tcp://HOST:8786.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make control points with chips from two or more overlapping images."""
    sources = (images or None, catalogue, selection)
    if sum(source is not None for source in sources) != 1:
        raise InputError("one of --images, --catalogue and --selection is expected")
    absent = [image for image in images or () if "://" not in image and not Path(image).exists()]
    if absent:
        raise InputError(
            f"--images: no file {', '.join(absent)}; expected paths, s3://BUCKET/KEY or https://…"
        )
    fine_m, coarse_m = sampling_pair(gsd_m)
    options = ProductionOptions(
        fine_gsd_m=fine_m, coarse_gsd_m=coarse_m, spacing_m=spacing_m, points=points, min_views=min_views
    )
    identity = BlockIdentity(block_id or output.name, version, title, license_name)
    place = WorkPlace(work, ComputeOptions(jobs, cluster))
    control_files = control_options.control_files(
        control=control,
        sigma_m=control_sigma_m,
        frame_sigma_m=control_frame_sigma_m,
        mark_sigma_px=control_mark_sigma_px,
        vertical=control_vertical,
        geoid=control_geoid,
        crs=control_crs,
        columns=control_columns,
        sigma_axes=control_sigma_axes,
        ortho=control_ortho,
        ortho_sigma_m=control_ortho_sigma_m,
        dem=control_dem,
        dem_vertical=control_dem_vertical,
        dem_geoid=control_dem_geoid,
        dem_sigma_m=control_dem_sigma_m,
        dem_frame_sigma_m=control_dem_frame_sigma_m,
    )
    control_files = replace(control_files, neighbour=neighbour)
    refuse_existing(output)
    with shown_progress() as progress:
        if catalogue is not None:
            selection = output.with_name(f"{output.name}.selection")
            first_day = None if since is None else since.replace(tzinfo=UTC)
            request = CatalogueRequest(catalogue, area, first_day)
            run_selection(request, selection, progress=part_of(progress, 0.0, _SHARE_OF_SELECTION))
        production = run_image_production(
            ProductionImages(
                tuple(map(file_place, images or ())),
                selection,
                sigma_m,
                control_files,
                GroundFiles(tuple(exclude or ()), land_cover),
            ),
            output,
            identity,
            options,
            place=place,
            progress=part_of(progress, _SHARE_OF_SELECTION, 1.0 - _SHARE_OF_SELECTION),
        )
    relative = production.relative_accuracy
    if not as_json:
        Console(width=None if Console().is_terminal else _TABLE_WIDTH).print(
            adjustment_table(production.image_fits)
        )
    show_one(
        {
            "block": output,
            "report": output.with_name(f"{output.name}.adjustment") / "report.html",
            "points": len(production.points),
            "views": int(production.points.views.start[-1]),
            "tie_points": relative.tie_points,
            "ray_residual_delivered_px": round(relative.before_px, 3),
            "ray_residual_adjusted_px": round(relative.after_px, 3),
            "ray_residual_points_px": round(relative.refined_px, 3),
            **control_row(production.control, production.adjustment),
            **effort_row(production.effort, as_json=as_json),
            **accuracy_row(production.points, as_json=as_json),
        },
        as_json=as_json,
    )
