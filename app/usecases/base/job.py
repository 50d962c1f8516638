"""The process `make-base`: a base from the archives that the operator allows, staged or published."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from amers.app.auth import Scope
from amers.app.config import Settings
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.errors import InputError
from amers.app.usecases.base.made import MadeBase
from amers.app.usecases.base.making import make_base
from amers.app.usecases.base.request import BaseOptions, BaseRequest, area_of
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.processes import Commit, Process, Work, work_folder
from amers.app.usecases.server_files import file_below
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.block.document import NAME_PATTERN
from amers.services.quality.accuracy_statement import accuracy_document
from amers.services.types import part_of

_SETTING = "AMERS_REFERENCE_FOLDER"


@dataclass(frozen=True)
class MakeBase:
    """The inputs of a base; its images come from the catalogues of AMERS_CATALOGUES, and no others.

    Attributes:
        id: name of the block.
        bbox: west, south, east, north of the region, degrees.
        archive: archive whose images are used.
        version, title: of the block.
        since: leave out images before this day, UTC: YYYY-MM-DD.
        dates: number of clear dates that every place needs, distributed over seasons and orbits.
        spacing_m: side of the squares that get one point each, metres; by default a hundred pixels, less
            in a small region.
        max_cloud: largest cloud cover of an image according to its catalogue, percent.
        min_clear: smallest clear share of an image in the region according to its mask, percent.
        dem: heights of the ground, a path below AMERS_REFERENCE_FOLDER; by default the Copernicus DEM of
            the catalogues.
        vertical: vertical datum of these heights, if the file does not state it.
        geoid: grid of the geoid, a path below AMERS_REFERENCE_FOLDER, if PROJ has none.
        publish: whether the block is published at once.
    """

    id: str
    bbox: tuple[float, float, float, float]
    archive: Literal["sentinel-2", "landsat"] = "sentinel-2"
    version: str = "1"
    title: str = ""
    since: str | None = None
    dates: int = 8
    spacing_m: float | None = None
    max_cloud: float = 60.0
    min_clear: float = 60.0
    dem: str | None = None
    vertical: str | None = None
    geoid: str | None = None
    publish: bool = False


def _check(connection: Connection, caller: Token, inputs: MakeBase) -> None:
    """Check the inputs but not the files, which may lie on a disk that only the worker has."""
    if not NAME_PATTERN.fullmatch(inputs.id):
        raise InputError(
            f"id: {inputs.id!r:.100} found, a letter, then letters, digits, dots, dashes or underscores "
            "expected"
        )
    area_of(BaseRequest(inputs.archive, (), bbox=inputs.bbox))
    if not 2 <= inputs.dates <= 50:
        raise InputError(f"dates: {inputs.dates} found, 2 to 50 expected")
    if inputs.spacing_m is not None and not inputs.spacing_m >= 1.0:
        raise InputError(f"spacing_m: {inputs.spacing_m:g} found, 1 m at least expected")
    for name in ("max_cloud", "min_clear"):
        if not 0.0 <= getattr(inputs, name) <= 100.0:
            raise InputError(f"{name}: {getattr(inputs, name):g} found, 0 to 100 percent expected")
    if inputs.dem is None and inputs.vertical is not None:
        raise InputError(
            "vertical: given without dem, whose heights it describes; add dem, or leave vertical out"
        )


def _run(work: Work) -> Commit:
    """Make the base; the transaction that ends the job loads it completely or not at all."""
    inputs: MakeBase = work.inputs
    request, options = _request(work.settings, inputs), _options(inputs)
    identity = BlockIdentity(inputs.id, inputs.version, inputs.title)
    # Lives as long as the transaction may need it; it ends with the attempt's process at the latest.
    scratch = tempfile.TemporaryDirectory(prefix="amers-base-")
    folder = Path(scratch.name) / "block"
    with work.storage.lasting_folder(work_folder(work.job.id)) as kept:
        progress = part_of(work.progress, 0.0, 0.9)
        place = WorkPlace(kept / "base")
        made = make_base(request, folder, identity, options, place=place, progress=progress)

    def commit(connection: Connection) -> dict[str, Any]:
        with scratch:
            ingested = lifecycle.ingest_block(
                connection, work.storage, folder, part_of(work.progress, 0.9, 0.1), 0
            )
        block = ingested.block
        if inputs.publish:
            block = lifecycle.publish_block(connection, str(block.number)).block
        return {
            "number": block.number,
            "id": block.id,
            "version": block.version,
            "state": block.state,
            "points": block.n_points,
            **accuracy_document(ingested.stated),
            **_figures(made),
        }

    return commit


def _request(settings: Settings, inputs: MakeBase) -> BaseRequest:
    """The request with the files and catalogues that the settings allow.

    Raises:
        InputError: there are none, or a path does not lead to a file below the folder.
    """
    if not settings.catalogues:
        raise InputError(
            "this server makes no bases, because AMERS_CATALOGUES is not set: the catalogues that it "
            "may contact"
        )

    def file(name: str, path: str | None) -> Path | None:
        if path is None:
            return None
        if settings.reference_folder is None:
            raise InputError(f"{name}: no file can be used, because {_SETTING} is not set")
        return file_below(settings.reference_folder, path, name, _SETTING)

    dem, geoid = file("dem", inputs.dem), file("geoid", inputs.geoid)
    terrain = None if dem is None else TerrainFile(dem, inputs.vertical, geoid, is_uploaded=True)
    return BaseRequest(
        inputs.archive,
        settings.catalogues,
        bbox=inputs.bbox,
        terrain=terrain,
        geoid=geoid,
        since=inputs.since,
    )


def _options(inputs: MakeBase) -> BaseOptions:
    return BaseOptions(
        dates=inputs.dates,
        spacing_m=inputs.spacing_m,
        max_cloud=inputs.max_cloud,
        min_clear=inputs.min_clear,
    )


def _figures(made: MadeBase) -> dict[str, Any]:
    frames = made.placed.frames
    return {
        "dates": made.placed.dates,
        "dates_apart_m": round(frames.apart_m, 2),
        "sigma_m": round(frames.sigma_m, 2),
        "bytes_read": made.bytes,
        "attribution": made.attribution,
    }


MAKE_BASE = Process(
    id="make-base",
    title="Make a base",
    description="Make control points for a region from an open archive of images, and stage or publish "
    "their block.",
    scope=Scope.ADMIN,
    inputs=MakeBase,
    outputs={},
    check=_check,
    run=_run,
    values={
        "number": {"type": "integer", "title": "Number of the block"},
        "id": {"type": "string", "title": "Name of the block"},
        "version": {"type": "string", "title": "Version"},
        "state": {"enum": ["staged", "published"], "title": "State of the block"},
        "points": {"type": "integer", "title": "Points of the block"},
        "relative_to_control_points": {"type": "object", "title": "Accuracy within the block"},
        "on_the_earth": {"type": "object", "title": "Accuracy on the Earth"},
        "dates": {"type": "array", "items": {"type": "string"}, "title": "Dates of its images"},
        "dates_apart_m": {"type": "number", "title": "Largest distance between two dates, metres"},
        "sigma_m": {"type": "number", "title": "Error of the frame, one sigma per coordinate, metres"},
        "bytes_read": {"type": "integer", "title": "Bytes read at addresses"},
        "attribution": {"type": "string", "title": "Attribution that the terms of the data require"},
    },
)
