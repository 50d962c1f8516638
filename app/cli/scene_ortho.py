"""`amers scene ortho`: a scene as an ortho-image."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.options import Shown
from amers.app.cli.output import AsJson, show_one
from amers.app.cli.progress import shown_progress
from amers.app.cli.terrain_options import NeededTerrain
from amers.app.errors import InputError
from amers.app.usecases.model_choice import ModelChoice
from amers.app.usecases.orthorectification import OrthoMap, run_orthorectification
from amers.services.formats.sensor_models.rpc_files import ImageFiles
from amers.services.orthorectification.rectify import OrthoOptions

Options = Annotated[OrthoOptions, Shown(tolerance_px=typer.Option(min=1e-4), hide=None)]


def ortho(
    scene: Annotated[
        Path,
        typer.Argument(
            exists=True,
            help="Image: GeoTIFF, JPEG 2000, NITF, or DIM_….XML, .TIL or folder of a product in tiles.",
        ),
    ],
    *,
    ground: NeededTerrain,
    registered: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            file_okay=False,
            help="Folder of the registration of the scene, whose model is used; by default the "
            "delivered model.",
        ),
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="GeoTIFF to write.")],
    models: ModelChoice,
    ortho_map: Annotated[OrthoMap, Shown(crs=None, gsd_m=typer.Option(min=0.001))],
    kernel: Annotated[str, typer.Option(help="Interpolation: cubic or bilinear.")] = "cubic",
    options: Options,
    as_json: AsJson = False,
) -> None:
    """Orthorectify a scene through its model and a terrain into a cloud-optimised GeoTIFF."""
    if kernel not in ("cubic", "bilinear"):
        raise InputError(f"--kernel: {kernel} found, cubic or bilinear expected")
    model, crop_origin = models.of([scene])[scene]
    with shown_progress() as progress:
        orthorectified = run_orthorectification(
            ImageFiles(scene, model, crop_origin),
            ground.terrain,
            output,
            ortho_map=ortho_map,
            options=replace(options, kernel="cubic" if kernel == "cubic" else "bilinear"),
            registration=registered,
            progress=progress,
        )
    show_one(asdict(orthorectified), as_json=as_json)
