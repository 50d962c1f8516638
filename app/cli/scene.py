"""`amers scene`: register and orthorectify scenes."""

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from app.cli.exit_status import SUCCESS
from app.cli.joint_registration import JointRequest, register_together
from app.cli.output import AsJson, print_json, show, show_one
from app.cli.progress import shown_progress
from app.cli.scene_registration import (
    Control,
    Outcome,
    Remote,
    SceneRequest,
    failure_text,
    images_of,
    register_scenes,
    worst_status,
)
from app.errors import InputError
from app.usecases.orthorectification import OrthoMap, run_orthorectification
from app.usecases.registration.reference_source import ReferenceFiles, check_map
from app.usecases.registration.register import SceneFiles
from app.usecases.terrain_file import TerrainFile
from services.orthorectification.rectify import OrthoOptions
from services.quality.accuracy_statement import ON_THE_EARTH, RELATIVE
from services.sensors.parameter_sets import parameter_set_named

app = typer.Typer(no_args_is_help=True)

_TABLE = ("active", "shift_m", "residual_rms_px", "check_ce90_m", "seconds")
"""Figures of a scene in the table of many scenes."""
_STATED = ("relative_to_control_points", "on_the_earth")
"""The two accuracies of an outcome."""


@app.command()
def register(
    scenes: Annotated[
        list[Path], typer.Argument(help="GeoTIFF, JPEG 2000 or NITF, or folders of such images.")
    ],
    *,
    block: Annotated[
        Path | None, typer.Option(help="Use the points of this block folder instead of the store.")
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(help="Ortho-image to register on; with --block only where it has no points."),
    ] = None,
    dem: Annotated[
        Path | None, typer.Option(help="GeoTIFF with the heights of the reference's ground.")
    ] = None,
    vertical: Annotated[
        str | None, typer.Option(help="Vertical datum of these heights: ellipsoid, EGM96, EPSG:…")
    ] = None,
    geoid: Annotated[Path | None, typer.Option(help="Grid file of the geoid, GTX or GeoTIFF.")] = None,
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
        Path | None, typer.Option(help="File of the model; by default it is found by its name.")
    ] = None,
    bands: Annotated[
        str | None, typer.Option(help="Bands to use: 2, or 1,2,3 for their mean, or 3:0.3,2:0.7.")
    ] = None,
    mask: Annotated[
        Path | None, typer.Option(help="Image of the same ground; pixels that are not 0 are not used.")
    ] = None,
    check_points: Annotated[
        Path | None, typer.Option(help="Points held out: ASP, QGIS, ENVI, ODM, PCI, GeoJSON or OPF.")
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
    _refuse_shared_files(images, [name for name, file in files_of_one.items() if file is not None])
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
        if outcome["exit_status"] != SUCCESS:
            typer.echo(f"amers: {failure_text(outcome)}", err=True)
    if is_one_scene:
        _show_one_scene(outcomes[0], as_json=as_json)
    else:
        _show_scenes(outcomes, as_json=as_json)
    raise typer.Exit(worst_status(outcomes))


@app.command("register-many")
def register_many(
    scenes: Annotated[
        list[Path], typer.Argument(help="GeoTIFF, JPEG 2000 or NITF, or folders of such images.")
    ],
    *,
    block: Annotated[
        Path | None, typer.Option(help="Use the points of this block folder instead of the store.")
    ] = None,
    join: Annotated[
        Path | None,
        typer.Option(help="Output folder of scenes registered together before; they stay as they are."),
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
    _refuse_shared_files(images, [])
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
        if outcome["exit_status"] != SUCCESS:
            typer.echo(f"amers: {failure_text(outcome)}", err=True)
    if as_json:
        print_json({**joint, "scenes": outcomes})
    else:
        _show_scenes(outcomes, as_json=False)
        if joint:
            show_one(joint, as_json=False)
    raise typer.Exit(worst_status(outcomes))


@app.command()
def ortho(
    scene: Annotated[Path, typer.Argument(help="GeoTIFF, JPEG 2000 or NITF.")],
    *,
    dem: Annotated[Path, typer.Option(help="GeoTIFF with the heights of the ground.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="GeoTIFF to write.")],
    model: Annotated[
        Path | None,
        typer.Option(help="File of the model, such as a refined one; by default found by its name."),
    ] = None,
    vertical: Annotated[
        str | None,
        typer.Option(help="Vertical datum of the heights: ellipsoid, EGM96, EGM2008, EPSG:…"),
    ] = None,
    geoid: Annotated[Path | None, typer.Option(help="Grid file of the geoid, GTX or GeoTIFF.")] = None,
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


def _refuse_shared_files(scenes: list[Path], files_of_one: list[str]) -> None:
    """Refuse files of one scene with several scenes, and scenes that would share an output folder."""
    if files_of_one and len(scenes) > 1:
        raise InputError(
            f"{', '.join(files_of_one)}: belongs to one scene, but {len(scenes)} scenes are given"
        )
    names = [scene.stem for scene in scenes]
    if len(set(names)) < len(names):
        raise InputError(
            "several scenes of the same name would write into the same folder; register them separately"
        )


def _show_one_scene(outcome: Outcome, *, as_json: bool) -> None:
    if as_json:
        print_json(outcome)
    else:
        show_one(_verdict_rows(outcome) | _other_rows(outcome, tuple(outcome)), as_json=False)


def _show_scenes(outcomes: list[Outcome], *, as_json: bool) -> None:
    """Print the outcome of every scene, or a table of the figures that compare scenes."""
    if as_json:
        print_json(outcomes)
        return
    rows = []
    for outcome in outcomes:
        row = _verdict_rows(outcome) | _other_rows(outcome, _TABLE)
        rows.append(row | {"reason": outcome["reason"] if outcome["exit_status"] else None})
    show(rows, as_json=False)


def _verdict_rows(outcome: Outcome) -> dict[str, Any]:
    """Scene, verdict and the accuracy it speaks of, and the two accuracies, for people."""
    scope = outcome.get("verdict_scope")
    verdict = f"{outcome['verdict']}, {scope}" if scope else outcome["verdict"]
    rows = {"scene": outcome["scene"], "verdict": verdict, RELATIVE: None, ON_THE_EARTH: None}
    stated = (outcome.get(name) for name in _STATED)
    return rows | {one["label"]: one["words"] for one in stated if one}


def _other_rows(outcome: Outcome, names: tuple[str, ...]) -> dict[str, Any]:
    """The other figures of an outcome, for people."""
    shown = {"scene", "verdict", "verdict_scope", *_STATED}
    return {name: _rounded(outcome.get(name)) for name in names if name not in shown}


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:.3f}"
    if isinstance(value, list):
        return ", ".join(f"{number:+.3f}" for number in value)
    return value
