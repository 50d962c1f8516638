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
from app.usecases.orthorectification import OrthoMap, run_orthorectification
from app.usecases.references import references_of_store
from app.usecases.registration.control_sources import points_of_block, points_of_store
from app.usecases.registration.reference_source import ReferenceFiles, this_reference
from app.usecases.registration.register import SceneFiles, key_of_file, record, run_registration
from app.usecases.terrain_file import TerrainFile
from services.orthorectification.rectify import OrthoOptions
from services.registration.options import RegistrationOptions
from services.reports.document import report_document
from services.types import Progress

app = typer.Typer(help="Scenes and their registration.", no_args_is_help=True)

Register = Callable[[SceneFiles, Path, Progress, bool], dict[str, Any]]
"""Registers one scene, writes what came out of it into a folder, returns the report as a document; the
last says whether its image is copied."""


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
    bands: Annotated[
        str | None, typer.Option(help="Looked at: 2, or 1,2,3 for their mean, or 3:0.3,2:0.7.")
    ] = None,
    mask: Annotated[
        Path | None, typer.Option(help="Image of the same ground, not zero where not to look.")
    ] = None,
    check_points: Annotated[
        Path | None, typer.Option(help="Points held out: ASP, QGIS, ENVI, ODM, PCI, GeoJSON or OPF.")
    ] = None,
    check_heights: Annotated[
        str | None,
        typer.Option(
            help="What their heights are above, where the file does not say: ellipsoid, EPSG:…"
        ),
    ] = None,
    copy_image: Annotated[
        bool, typer.Option("--copy-image", help="Copy a GeoTIFF, the refined model in its tags.")
    ] = False,
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
    of_one = {"--model": model, "--mask": mask, "--check-points": check_points}
    _refuse_contradictions(block, reference, dem, server)
    _refuse_mixed_up(scenes, [name for name, file in of_one.items() if file is not None])
    try:
        terrain = None if dem is None else TerrainFile(dem, vertical, geoid)
        held = None if reference is None else ReferenceFiles(reference, terrain)
        with _registrar(block, held, server, token) as do:
            outcomes = [
                _one(
                    do,
                    SceneFiles(scene, model, sigma_m, bands, mask, check_points, check_heights),
                    folder,
                    copy_image,
                )
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
            scene,
            terrain,
            output,
            model=model,
            ortho_map=OrthoMap(crs, gsd_m),
            options=options,
            progress=progress,
        )
    show_one(asdict(made), as_json=as_json)


def _refuse_contradictions(
    block: Path | None, reference: Path | None, dem: Path | None, server: str | None
) -> None:
    if server is not None and (reference is not None or block is not None):
        raise InputError("--server excludes --reference and --block: the service has its own")
    if dem is not None and reference is None:
        raise InputError("--dem is the ground of a --reference")


def _refuse_mixed_up(scenes: list[Path], of_one: list[str]) -> None:
    """Refuse files of one scene for several, and scenes that would write into the same folder."""
    if of_one and len(scenes) > 1:
        raise InputError(f"{', '.join(of_one)}: of one scene, {len(scenes)} given")
    names = [scene.stem for scene in scenes]
    if len(set(names)) < len(names):
        raise InputError("several scenes of the same name would write into the same folder")


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
    find_reference = None if reference is None else this_reference(reference)

    def do(files: SceneFiles, folder: Path, progress: Progress, copy_image: bool) -> dict[str, Any]:
        made = run_registration(
            files,
            find_points,
            RegistrationOptions(),
            folder,
            progress,
            find_reference,
            copy_image=copy_image,
        )
        return report_document(made.report)

    return do


@contextmanager
def _on_store() -> Iterator[Register]:
    """Registers with the points of the store, which remembers the registration and its measures."""
    settings = read_settings()
    storage = open_storage(settings)
    with engine.opened(settings) as database:

        def do(files: SceneFiles, folder: Path, progress: Progress, copy_image: bool) -> dict[str, Any]:
            made = run_registration(
                files,
                points_of_store(database, storage),
                RegistrationOptions(),
                folder,
                progress,
                references_of_store(database, settings),
                copy_image=copy_image,
            )
            with database.transaction() as connection:
                record(connection, made, key_of_file(files.image))
            return report_document(made.report)

        yield do


def _one(do: Register, files: SceneFiles, folder: Path, copy_image: bool) -> dict[str, Any] | AmersError:
    """What is shown of one registered scene, or why it was not registered."""
    try:
        with shown_progress() as progress:
            report = do(files, folder, progress, copy_image)
    except AmersError as error:
        return error
    if report["verdict"] == "failed":
        return ComputationError(
            f"{files.image}: registered, but not to be trusted: see {folder / 'report.html'}"
        )
    counts, correction = report["point_counts"], report["correction"]
    return {
        "scene": files.image,
        "verdict": report["verdict"],
        "visible": counts["visible"],
        "matched": counts["matched"],
        "active": counts["active"],
        "correction": correction["order"],
        "shift_px": correction["shift_px"],
        "shift_m": correction["shift_m"],
        "residual_rms_px": report["image_residuals_px"]["xy"]["rms"],
        "ce90_predicted_px": report["predicted"]["worst_px"],
        **_check_figures(report["checks"]),
        "output": folder,
    }


def _check_figures(checks: list[dict[str, Any]]) -> dict[str, Any]:
    """What is shown of independent check points, if there are any."""
    if not checks:
        return {}
    accuracy = checks[0]["accuracy"]
    return {"check_points": accuracy["n"], "check_ce90_m": accuracy["ce90_m"]["value"]}


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
