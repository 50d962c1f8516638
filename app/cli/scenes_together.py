"""`amers scene register-many`: scenes registered in one adjustment."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.control_options import MarkOptions
from amers.app.cli.joint_registration import JointRequest, register_together
from amers.app.cli.options import FromMilli, words_of
from amers.app.cli.output import AsJson, print_json, show_one
from amers.app.cli.scene_registration import images_of, worst_status
from amers.app.cli.scene_rows import refuse_shared_files, show_failures, show_outcomes
from amers.app.usecases.model_choice import ModelChoice, metres_by_image
from amers.app.usecases.registration.register import SceneFiles
from amers.services.sensors.parameter_sets import parameter_set_named


@dataclass(frozen=True)
class JointOptions:
    """What scenes are registered on together, and what the result must reach.

    Attributes:
        block: block folder whose points are used instead of the store.
        join: output folder of scenes that were registered together before; they stay unchanged.
        sigma_m: accuracy of the delivered sensor models, one sigma, metres; for one of the images write
            IMAGE=M, and repeat the option.
        bands: bands to use: 2, or 1,2,3 for their mean, or 3:0.3,2:0.7.
        rigorous: adjust orbit, attitude and camera of scenes whose metadata contain a rigorous model;
            the value is the set of parameters: srp, toutin or spot-hrv.
        max_ce90_on_earth_m: largest allowed CE90 on the Earth, metres, including the common error of the
            points.
        copy_image: also write copies of GeoTIFFs with the refined models in their tags.
    """

    block: Path | None = None
    join: Path | None = None
    sigma_m: Annotated[tuple[str, ...], typer.Option()] = ()
    bands: str | None = None
    rigorous: str | None = None
    max_ce90_on_earth_m: FromMilli = None
    copy_image: bool = False


def register_many(
    context: typer.Context,
    scenes: Annotated[
        list[Path],
        typer.Argument(
            help="Images: GeoTIFF, JPEG 2000, NITF, DIM_….XML or .TIL of a product in tiles, or "
            "folders of these."
        ),
    ],
    *,
    models: ModelChoice,
    options: JointOptions,
    marks: MarkOptions,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Output folder; each scene gets its own folder inside it."),
    ] = Path("registered"),
    jobs: Annotated[int, typer.Option(help="Number of processes that search images.", min=1)] = 1,
    as_json: AsJson = False,
) -> None:
    """Refine the models of scenes in one adjustment, on control points and tie points between them.

    Tie points to neighbouring scenes also determine scenes with few control points. A scene that does
    not fit is named and left out. The folder OUTPUT/block contains the report on all scenes. The points
    come from the store unless --block or --control is given.
    """
    rigorous = options.rigorous
    if rigorous is not None:
        parameter_set_named(rigorous)
    images = images_of(scenes)
    refuse_shared_files(images, [])
    sigmas_m = metres_by_image("--sigma-m", options.sigma_m, images)
    request = JointRequest(
        files=[
            SceneFiles(
                image,
                model,
                sigmas_m.get(image),
                options.bands,
                rigorous=rigorous,
                crop_origin=origin,
            )
            for image, (model, origin) in models.of(images).items()
        ],
        output=output,
        block=options.block,
        marks=marks.files(of_many=len(images) > 1),
        joined=options.join,
        copy_image=options.copy_image,
        max_ce90_on_earth_m=options.max_ce90_on_earth_m,
        jobs=jobs,
        # Without the accuracy of the models, which the report of a failure advises to state anew.
        words=[*words_of(models), *words_of(replace(options, sigma_m=())), *words_of(marks)],
    )
    outcomes, joint = register_together(request)
    show_failures(outcomes, context)
    if as_json:
        print_json({**joint, "scenes": outcomes})
    else:
        show_outcomes(outcomes, as_json=False)
        if joint:
            show_one(joint, as_json=False)
    raise typer.Exit(worst_status(outcomes))
