"""`amers scene straighten`: a scene without the motion of its lines and samples."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.output import AsJson, show_one
from amers.app.cli.progress import shown_progress
from amers.app.usecases.model_choice import ModelChoice
from amers.app.usecases.straightening import run_straightening
from amers.services.formats.sensor_models.rpc_files import ImageFiles


def straighten(
    scene: Annotated[
        Path,
        typer.Argument(
            exists=True,
            help="Image: GeoTIFF, JPEG 2000, NITF, or DIM_….XML, .TIL or folder of a product in tiles.",
        ),
    ],
    *,
    registered: Annotated[
        Path,
        typer.Option(
            exists=True,
            file_okay=False,
            help="Folder of the registration of the scene, the output of `amers scene register`.",
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="GeoTIFF to write.")],
    models: ModelChoice,
    as_json: AsJson = False,
) -> None:
    """Resample a registered scene with displaced lines or samples, so that an RPC fits its model."""
    model, crop_origin = models.of([scene])[scene]
    with shown_progress() as progress:
        made = run_straightening(ImageFiles(scene, model, crop_origin), registered, output, progress)
    show_one(asdict(made), as_json=as_json)
