"""`amers scene`: scenes and their registration."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from app.cli.output import AsJson, print_json, show_one
from app.cli.progress import shown_progress
from app.cli.remote import Service, ServiceFailure
from app.config import read_settings
from app.db import engine
from app.errors import AmersError, ComputationError, InputError
from app.storage import open_storage
from app.usecases.orthorectification import OrthoMap, TerrainFile, run_orthorectification
from app.usecases.reference import ReferenceFiles
from app.usecases.registration import (
    SceneFiles,
    key_of_file,
    points_of_block,
    points_of_store,
    record,
    run_registration,
)
from services.orthorectify import OrthoOptions
from services.registration import RegistrationOptions
from services.reports.document import report_document
from services.types import Progress

app = typer.Typer(help="Scenes and their registration.", no_args_is_help=True)

Register = Callable[[SceneFiles, Path, Progress], dict[str, Any]]
"""Registers one scene, writes what came out of it into a folder, returns the report as a document."""


@app.callback()
def group() -> None:
    """Scenes and their registration."""


@app.command()
def register(
    scenes: Annotated[list[Path], typer.Argument(help="GeoTIFF, JPEG 2000 or NITF.")],
    block: Annotated[
        Path | None, typer.Option(help="Take the points from this block folder; no database.")
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(help="Ortho-image to register on; beside --block, where the block has no point."),
    ] = None,
    dem: Annotated[
        Path | None, typer.Option(help="GeoTIFF with the heights of the ground of the reference.")
    ] = None,
    vertical: Annotated[
        str | None, typer.Option(help="What these heights are counted from: ellipsoid, EGM96, EPSG:…")
    ] = None,
    geoid: Annotated[Path | None, typer.Option(help="Grid file of the geoid, GTX or GeoTIFF.")] = None,
    sigma_m: Annotated[
        float | None, typer.Option(help="Accuracy of the model, metres.", min=0.01)
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="File of the model, if it is not found by itself.")
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder; one inside it for each of several scenes.")
    ] = Path("registered"),
    server: Annotated[str | None, typer.Option(help="Let this service do it.")] = None,
    token: Annotated[
        str | None,
        typer.Option(envvar="AMERS_TOKEN", help="For the service; better in the environment."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Refine the model of scenes on control points: report, points and refined model go into a folder.

    Points come from the store unless --block, --reference or --server says otherwise.
    """
    if reference is not None and server is not None:
        raise InputError("--reference and --server exclude each other")
    if dem is not None and reference is None:
        raise InputError("--dem is the ground of a --reference")
    if block is not None and server is not None:
        raise InputError("--block and --server exclude each other")
    if model is not None and len(scenes) > 1:
        raise InputError("--model is the model of one scene")
    names = [scene.stem for scene in scenes]
    if len(set(names)) < len(names):
        raise InputError("several scenes of the same name would write into the same folder")
    try:
        terrain = None if dem is None else TerrainFile(dem, vertical, geoid)
        held = None if reference is None else ReferenceFiles(reference, terrain)
        with _registrar(block, held, server, token) as do:
            outcomes = [
                _one(do, SceneFiles(scene, model, sigma_m), folder)
                for scene, folder in _folders(scenes, output)
            ]
    except ServiceFailure as failure:
        typer.echo(f"amers: {failure}", err=True)
        raise typer.Exit(1) from failure
    _show([outcome for outcome in outcomes if isinstance(outcome, dict)], as_json, len(scenes))
    _raise_worst([outcome for outcome in outcomes if isinstance(outcome, AmersError)])


@app.command()
def ortho(
    scene: Annotated[Path, typer.Argument(help="GeoTIFF, JPEG 2000 or NITF.")],
    dem: Annotated[Path, typer.Option(help="GeoTIFF with the heights of the ground.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The GeoTIFF to write.")],
    model: Annotated[
        Path | None,
        typer.Option(help="File of the model, refined perhaps, if it is not found by itself."),
    ] = None,
    vertical: Annotated[
        str | None,
        typer.Option(help="What the heights are counted from: ellipsoid, EGM96, EGM2008, EPSG:…"),
    ] = None,
    geoid: Annotated[Path | None, typer.Option(help="Grid file of the geoid, GTX or GeoTIFF.")] = None,
    fill_px: Annotated[
        int, typer.Option(help="Fill voids of the terrain from so many nodes away.", min=0, max=50)
    ] = 0,
    crs: Annotated[
        str | None, typer.Option(help="Of the map; by default the UTM zone of the centre.")
    ] = None,
    gsd_m: Annotated[
        float | None, typer.Option(help="Ground sampling; by default that of the scene.", min=0.001)
    ] = None,
    kernel: Annotated[str, typer.Option(help="cubic or bilinear.")] = "cubic",
    tolerance_px: Annotated[
        float, typer.Option(help="How far positions may be from the model's, pixels.", min=1e-4)
    ] = 0.1,
    hide: Annotated[
        bool, typer.Option("--hide", help="Leave out ground that other ground hides from the sensor.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Lay a scene on a map through its model and a terrain: a cloud-optimised GeoTIFF with overviews."""
    if kernel not in ("cubic", "bilinear"):
        raise InputError(f"--kernel: expected cubic or bilinear, found {kernel}")
    options = OrthoOptions("cubic" if kernel == "cubic" else "bilinear", tolerance_px, hide)
    terrain = TerrainFile(dem, vertical, geoid, fill_px)
    with shown_progress() as progress:
        made = run_orthorectification(
            scene, model, terrain, output, OrthoMap(crs, gsd_m), options, progress
        )
    show_one(asdict(made), as_json=as_json)


def _folders(scenes: list[Path], output: Path) -> Iterator[tuple[Path, Path]]:
    for scene in scenes:
        yield scene, output if len(scenes) == 1 else output / scene.stem


@contextmanager
def _registrar(
    block: Path | None, reference: ReferenceFiles | None, server: str | None, token: str | None
) -> Iterator[Register]:
    """How scenes are registered: on a block folder, a reference, the store, or by a service."""
    if block is not None or reference is not None:
        yield _on_files(block, reference)
    elif server is not None:
        with Service(server, token or "") as service:
            yield service.register
    else:
        with _on_store() as do:
            yield do


def _on_files(block: Path | None, reference: ReferenceFiles | None) -> Register:
    find_points = None if block is None else points_of_block(block)

    def do(files: SceneFiles, folder: Path, progress: Progress) -> dict[str, Any]:
        options = RegistrationOptions()
        made = run_registration(files, find_points, options, folder, progress, reference)
        return report_document(made.report)

    return do


@contextmanager
def _on_store() -> Iterator[Register]:
    """Registers with the points of the store, which remembers the registration and its measures."""
    settings = read_settings()
    storage = open_storage(settings)
    with engine.opened(settings) as database:

        def do(files: SceneFiles, folder: Path, progress: Progress) -> dict[str, Any]:
            find_points = points_of_store(database, storage)
            made = run_registration(files, find_points, RegistrationOptions(), folder, progress)
            with database.transaction() as connection:
                record(connection, made, key_of_file(files.image))
            return report_document(made.report)

        yield do


def _one(do: Register, files: SceneFiles, folder: Path) -> dict[str, Any] | AmersError:
    """What is shown of one registered scene, or why it was not registered."""
    try:
        with shown_progress() as progress:
            report = do(files, folder, progress)
    except AmersError as error:
        return error
    if report["verdict"] == "failed":
        return ComputationError(
            f"{files.image}: registered, but not to be trusted: see {folder / 'report.html'}"
        )
    equipment, correction = report["equipment"], report["correction"]
    return {
        "scene": files.image,
        "verdict": report["verdict"],
        "visible": equipment["visible"],
        "matched": equipment["matched"],
        "active": equipment["active"],
        "correction": correction["order"],
        "shift_px": correction["shift_px"],
        "shift_m": correction["shift_m"],
        "residual_rms_px": report["image_residuals_px"]["xy"]["rms"],
        "ce90_predicted_px": report["predicted"]["worst_px"],
        "output": folder,
    }


def _show(records: list[dict[str, Any]], as_json: bool, asked: int) -> None:
    if as_json:
        print_json(records[0] if asked == 1 and records else records)
        return
    for found in records:
        show_one({name: _rounded(value) for name, value in found.items()}, as_json=False)


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:.3f}"
    if isinstance(value, list):
        return ", ".join(f"{number:+.3f}" for number in value)
    return value


def _raise_worst(errors: list[AmersError]) -> None:
    """Tell every error; the last one told ends the command, one of the input before one of the data."""
    ordered = sorted(errors, key=lambda error: not isinstance(error, ComputationError))
    for error in ordered[:-1]:
        typer.echo(f"amers: {error}", err=True)
    if ordered:
        raise ordered[-1]
