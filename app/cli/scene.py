"""`amers scene`: register and orthorectify scenes."""

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
from app.usecases.registration.reference_source import ReferenceFiles, given_reference
from app.usecases.registration.register import (
    ControlSources,
    SceneFiles,
    image_key,
    record_registration,
    run_registration,
)
from app.usecases.terrain_file import TerrainFile
from services.orthorectification.rectify import OrthoOptions
from services.reports.document import report_document
from services.types import Progress

app = typer.Typer(no_args_is_help=True)

Register = Callable[[SceneFiles, Path, Progress, bool], dict[str, Any]]
"""Registers one scene into a folder and returns its report; the last argument copies the image too."""


@app.command()
def register(
    scenes: Annotated[list[Path], typer.Argument(help="GeoTIFF, JPEG 2000 or NITF.")],
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
    copy_image: Annotated[
        bool, typer.Option("--copy-image", help="Copy a GeoTIFF with the refined model in its tags.")
    ] = False,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder; each of several scenes gets one inside it.")
    ] = Path("registered"),
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

    The points come from the store unless --block, --reference or --server is given.
    """
    files_of_one = {"--model": model, "--mask": mask, "--check-points": check_points}
    _refuse_contradictions(block, reference, dem, server)
    _refuse_shared_files(scenes, [name for name, file in files_of_one.items() if file is not None])
    try:
        terrain = None if dem is None else TerrainFile(dem, vertical, geoid)
        reference_files = None if reference is None else ReferenceFiles(reference, terrain)
        with _registrar(block, reference_files, server, token) as register_one:
            outcomes = [
                _outcome(
                    register_one,
                    SceneFiles(scene, model, sigma_m, bands, mask, check_points, check_heights),
                    folder,
                    copy_image,
                )
                for scene, folder in _output_folders(scenes, output)
            ]
    except ServiceFailure as failure:
        typer.echo(f"amers: {failure}", err=True)
        raise typer.Exit(1) from failure
    records = [outcome for outcome in outcomes if isinstance(outcome, dict)]
    _show(records, as_json=as_json, is_one_scene=len(scenes) == 1)
    _raise_worst([outcome for outcome in outcomes if isinstance(outcome, AmersError)])


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


def _output_folders(scenes: list[Path], output: Path) -> Iterator[tuple[Path, Path]]:
    for scene in scenes:
        yield scene, output if len(scenes) == 1 else output / scene.stem


@contextmanager
def _registrar(
    block: Path | None, reference: ReferenceFiles | None, server: str | None, token: str | None
) -> Iterator[Register]:
    """The function that registers scenes: on given files, by a service, or on the store."""
    if block is not None or reference is not None:
        yield _on_files(block, reference)
    elif server is not None:
        with Service(server, token or "") as service:
            yield service.register
    else:
        with _on_store() as register_one:
            yield register_one


def _on_files(block: Path | None, reference: ReferenceFiles | None) -> Register:
    """A function that registers scenes on a block folder, a reference, or both."""
    sources = ControlSources(
        find_points=None if block is None else points_of_block(block),
        find_reference=None if reference is None else given_reference(reference),
    )

    def register_one(
        files: SceneFiles, folder: Path, progress: Progress, copy_image: bool
    ) -> dict[str, Any]:
        registered = run_registration(files, sources, folder, copy_image=copy_image, progress=progress)
        return report_document(registered.report)

    return register_one


@contextmanager
def _on_store() -> Iterator[Register]:
    """A function that registers scenes on the store and records the registrations there."""
    settings = read_settings()
    storage = open_storage(settings)
    with engine.opened(settings) as database:
        sources = ControlSources(
            points_of_store(database, storage), references_of_store(database, settings)
        )

        def register_one(
            files: SceneFiles, folder: Path, progress: Progress, copy_image: bool
        ) -> dict[str, Any]:
            registered = run_registration(
                files, sources, folder, copy_image=copy_image, progress=progress
            )
            with database.transaction() as connection:
                record_registration(connection, registered, image_key(files.image))
            return report_document(registered.report)

        yield register_one


def _outcome(
    register_one: Register, files: SceneFiles, folder: Path, copy_image: bool
) -> dict[str, Any] | AmersError:
    """The figures to show of one registered scene, or the error that ended its registration."""
    try:
        with shown_progress() as progress:
            report = register_one(files, folder, progress, copy_image)
    except AmersError as error:
        return error
    if report["verdict"] == "failed":
        return ComputationError(
            f"{files.image}: the registration has the verdict failed, do not use its model; see "
            f"{folder / 'report.html'}"
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
    """The figures to show of independent check points, if there are any."""
    if not checks:
        return {}
    accuracy = checks[0]["accuracy"]
    return {"check_points": accuracy["n"], "check_ce90_m": accuracy["ce90_m"]["value"]}


def _show(records: list[dict[str, Any]], *, as_json: bool, is_one_scene: bool) -> None:
    if as_json:
        print_json(records[0] if is_one_scene and records else records)
        return
    for record in records:
        show_one({name: _rounded(value) for name, value in record.items()}, as_json=False)


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:.3f}"
    if isinstance(value, list):
        return ", ".join(f"{number:+.3f}" for number in value)
    return value


def _raise_worst(errors: list[AmersError]) -> None:
    """Print all errors but one, which is raised: an error of the input rather than of a computation."""
    ordered = sorted(errors, key=lambda error: not isinstance(error, ComputationError))
    for error in ordered[:-1]:
        typer.echo(f"amers: {error}", err=True)
    if ordered:
        raise ordered[-1]
