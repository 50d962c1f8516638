"""`amers scene register`: scenes registered one by one."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.arguments import by_options
from amers.app.cli.exit_status import SUCCESS
from amers.app.cli.output import AsJson
from amers.app.cli.scene_registration import (
    Control,
    Remote,
    SceneRequest,
    failure_text,
    images_of,
    register_scenes,
    worst_status,
)
from amers.app.cli.scene_rows import refuse_shared_files, show_outcome, show_outcomes, write_overview
from amers.app.errors import InputError
from amers.app.usecases.registration.reference_source import ReferenceFiles, check_map
from amers.app.usecases.registration.register import SceneFiles
from amers.app.usecases.terrain_file import TerrainFile


def register(
    context: typer.Context,
    scenes: Annotated[
        list[Path], typer.Argument(help="GeoTIFF, JPEG 2000 or NITF, or folders of such images.")
    ],
    *,
    block: Annotated[
        Path | None,
        typer.Option(exists=True, help="Use the points of this block folder instead of the store."),
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            exists=True, help="Ortho-image to register on; with --block only where it has no points."
        ),
    ] = None,
    dem: Annotated[
        Path | None,
        typer.Option(exists=True, help="GeoTIFF with the heights of the reference's ground."),
    ] = None,
    vertical: Annotated[
        str | None, typer.Option(help="Vertical datum of these heights: ellipsoid, EGM96, EPSG:…")
    ] = None,
    geoid: Annotated[
        Path | None, typer.Option(exists=True, help="Grid file of the geoid, GTX or GeoTIFF.")
    ] = None,
    reference_sigma_m: Annotated[
        float | None,
        typer.Option(help="Accuracy of the reference on the Earth, one sigma, metres.", min=0.001),
    ] = None,
    reference_sigma_up_m: Annotated[
        float | None,
        typer.Option(help="Accuracy of its heights on the Earth, one sigma, metres.", min=0.001),
    ] = None,
    sigma_m: Annotated[
        float | None, typer.Option(help="Accuracy of the model, one sigma, metres.", min=0.01)
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(exists=True, help="File of the model; by default it is found by its name."),
    ] = None,
    bands: Annotated[
        str | None, typer.Option(help="Bands to use: 2, or 1,2,3 for their mean, or 3:0.3,2:0.7.")
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(exists=True, help="Image of the same ground; pixels that are not 0 are not used."),
    ] = None,
    check_points: Annotated[
        Path | None,
        typer.Option(exists=True, help="Points held out: ASP, QGIS, ENVI, ODM, PCI, GeoJSON or OPF."),
    ] = None,
    check_heights: Annotated[
        str | None,
        typer.Option(help="Vertical datum of the check points, if not in the file: ellipsoid, EPSG:…"),
    ] = None,
    max_ce90_on_earth_m: Annotated[
        float | None,
        typer.Option(help="Largest CE90 on the Earth, metres: with the frame of the points.", min=0.001),
    ] = None,
    copy_image: Annotated[
        bool, typer.Option("--copy-image", help="Copy a GeoTIFF with the refined model in its tags.")
    ] = False,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder; each of several scenes gets one inside it.")
    ] = Path("registered"),
    jobs: Annotated[
        int, typer.Option(help="Number of scenes registered at once, each in a process.", min=1)
    ] = 1,
    server: Annotated[
        str | None, typer.Option(help="Address of an Amers service that does the registration.")
    ] = None,
    token: Annotated[
        str | None,
        typer.Option(envvar="AMERS_TOKEN", help="Token for the service; prefer the variable."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Refine the sensor models of scenes on control points; write report, points and refined models.

    Each of several scenes gets a folder in the output folder, and a failed one does not stop the others.
    An older result in a folder is replaced as a whole; other files there are refused.

    The points come from the store unless --block, --reference or --server is given.
    """
    images = images_of(scenes)
    is_one_scene = len(scenes) == len(images) == 1 and not scenes[0].is_dir()
    files_of_one = {"--model": model, "--mask": mask, "--check-points": check_points}
    _refuse_contradictions(block, reference, dem, server)
    refuse_shared_files(images, [name for name, file in files_of_one.items() if file is not None])
    if server is not None and jobs > 1:
        raise InputError("--jobs: the workers of the service do the jobs; leave it out with --server")
    terrain = None if dem is None else TerrainFile(dem, vertical, geoid)
    reference_files = None
    if reference is not None:
        check_map(reference)
        reference_files = ReferenceFiles(reference, terrain, reference_sigma_m, reference_sigma_up_m)
    elif reference_sigma_m is not None or reference_sigma_up_m is not None:
        raise InputError("--reference-sigma-m, --reference-sigma-up-m: of a reference; add --reference")
    control = Control(block, reference_files)
    requests = []
    for image in images:
        files = SceneFiles(image, model, sigma_m, bands, mask, check_points, check_heights)
        folder = output if is_one_scene else output / image.stem
        requests.append(
            SceneRequest(
                files,
                folder,
                copy_image,
                _command_for(files, control, folder, server),
                max_ce90_on_earth_m,
            )
        )
    outcomes = register_scenes(requests, control, Remote(server, token or "") if server else None, jobs)
    for outcome in outcomes:
        outcome["reason"] = by_options(outcome["reason"], context)
        if outcome["exit_status"] != SUCCESS:
            typer.echo(f"amers: {failure_text(outcome)}", err=True)
    if is_one_scene:
        show_outcome(outcomes[0], as_json=as_json)
    else:
        write_overview(outcomes, output)
        show_outcomes(outcomes, as_json=as_json)
    raise typer.Exit(worst_status(outcomes))


def _command_for(files: SceneFiles, control: Control, folder: Path, server: str | None) -> str:
    """The command that registers a scene again, without the accuracy of its model."""
    reference = control.reference
    terrain = None if reference is None else reference.terrain
    options = {
        "--model": files.model,
        "--bands": files.bands,
        "--mask": files.mask,
        "--check-points": files.check_points,
        "--check-heights": files.check_heights,
        "--block": control.block,
        "--reference": None if reference is None else reference.image,
        "--dem": None if terrain is None else terrain.dem,
        "--vertical": None if terrain is None else terrain.vertical,
        "--geoid": None if terrain is None else terrain.geoid,
        "--reference-sigma-m": None if reference is None else reference.sigma_m,
        "--reference-sigma-up-m": None if reference is None else reference.sigma_up_m,
        "--server": server,
        "-o": folder,
    }
    words = [str(word) for name, value in options.items() if value is not None for word in (name, value)]
    return shlex.join(["amers", "scene", "register", str(files.image), *words])


def _refuse_contradictions(
    block: Path | None, reference: Path | None, dem: Path | None, server: str | None
) -> None:
    if server is not None and (reference is not None or block is not None):
        raise InputError(
            "--server: the service uses its own points and references; leave out --block and --reference"
        )
    if dem is not None and reference is None:
        raise InputError("--dem: it has the heights of a reference; add --reference")
