"""`amers scene register-many`: scenes registered in one adjustment."""

from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.arguments import by_options
from amers.app.cli.exit_status import SUCCESS
from amers.app.cli.joint_registration import JointRequest, register_together
from amers.app.cli.output import AsJson, print_json, show_one
from amers.app.cli.scene_registration import failure_text, images_of, worst_status
from amers.app.cli.scene_rows import refuse_shared_files, show_outcomes
from amers.app.usecases.registration.register import SceneFiles
from amers.services.sensors.parameter_sets import parameter_set_named


def register_many(
    context: typer.Context,
    scenes: Annotated[
        list[Path], typer.Argument(help="GeoTIFF, JPEG 2000 or NITF, or folders of such images.")
    ],
    *,
    block: Annotated[
        Path | None,
        typer.Option(exists=True, help="Use the points of this block folder instead of the store."),
    ] = None,
    join: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            help="Output folder of scenes registered together before; they stay as they are.",
        ),
    ] = None,
    sigma_m: Annotated[
        float | None, typer.Option(help="Accuracy of the models, one sigma, metres.", min=0.01)
    ] = None,
    bands: Annotated[
        str | None, typer.Option(help="Bands to use: 2, or 1,2,3 for their mean, or 3:0.3,2:0.7.")
    ] = None,
    rigorous: Annotated[
        str | None,
        typer.Option(
            help="Adjust orbit, attitude and camera of the scenes whose metadata have a rigorous model: "
            "srp, toutin or spot-hrv."
        ),
    ] = None,
    max_ce90_on_earth_m: Annotated[
        float | None,
        typer.Option(help="Largest CE90 on the Earth, metres: with the frame of the points.", min=0.001),
    ] = None,
    copy_image: Annotated[
        bool, typer.Option("--copy-image", help="Copy GeoTIFFs with the refined model in their tags.")
    ] = False,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder; each scene gets one inside it.")
    ] = Path("registered"),
    jobs: Annotated[int, typer.Option(help="Number of processes that search images.", min=1)] = 1,
    as_json: AsJson = False,
) -> None:
    """Refine the models of scenes in one adjustment, on control points and tie points between them.

    Scenes with few control points are held by their neighbours. One that does not fit is named and left
    out. The folder OUTPUT/block holds the report on all scenes. The points come from the store unless
    --block is given.
    """
    if rigorous is not None:
        parameter_set_named(rigorous)
    images = images_of(scenes)
    refuse_shared_files(images, [])
    request = JointRequest(
        files=[SceneFiles(image, None, sigma_m, bands, rigorous=rigorous) for image in images],
        output=output,
        block=block,
        joined=join,
        copy_image=copy_image,
        max_ce90_on_earth_m=max_ce90_on_earth_m,
        jobs=jobs,
    )
    outcomes, joint = register_together(request)
    for outcome in outcomes:
        outcome["reason"] = by_options(outcome["reason"], context)
        if outcome["exit_status"] != SUCCESS:
            typer.echo(f"amers: {failure_text(outcome)}", err=True)
    if as_json:
        print_json({**joint, "scenes": outcomes})
    else:
        show_outcomes(outcomes, as_json=False)
        if joint:
            show_one(joint, as_json=False)
    raise typer.Exit(worst_status(outcomes))
