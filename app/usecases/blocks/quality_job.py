"""The process `assess-block`: the quality of a block of the store against files on the server."""

from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args

from amers.app.auth import Scope
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.errors import InputError
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.quality import (
    DOCUMENT,
    PAGE,
    HeightFiles,
    QualityReferences,
    RequiredQuality,
    SiteFile,
    write_quality_files,
)
from amers.app.usecases.blocks.stored_quality import assess_stored
from amers.app.usecases.processes import Commit, Process, Work
from amers.app.usecases.results import store_results
from amers.app.usecases.scene_inputs import naming
from amers.app.usecases.server_files import file_below
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.elevation.geoid import vertical_crs
from amers.services.quality.block_requirements import BlockVerdict


@dataclass(frozen=True)
class AssessBlock:
    """The inputs of an assessment; paths are relative to AMERS_REFERENCE_FOLDER.

    Attributes:
        block: number, ID or ID@VERSION of the block, in any state.
        sites: reference ortho-images of places that the production did not use.
        control_sites: reference ortho-images of places that the production used as control.
        site_sigma_m: accuracy of the reference ortho-images on the Earth, one standard deviation per
            coordinate, metres.
        search_m: largest shift that is searched at the reference images, metres; by default three times
            the sigma that block and images declare.
        dem: heights that the heights of the points are compared with.
        vertical: vertical datum of these heights, if the file does not state it.
        geoid: grid file of the geoid, if PROJ has none.
        dem_sigma_m: sigma of single heights, metres; by default the sigma of each cell of a surface,
            otherwise a tenth of the posting.
        dem_frame_sigma_m: sigma of the common error of all heights, metres; by default unknown.
        exclude: masks of ground where no points are expected: GeoJSON, or images on a map that are not 0
            there.
        exclude_heights: masks of ground where the heights of `dem` must not be used.
        land_cover: image of land cover classes on a map; errors of heights are also reported by class.
        required: requirements for the block.
    """

    block: str
    sites: tuple[str, ...] = ()
    control_sites: tuple[str, ...] = ()
    site_sigma_m: float | None = None
    search_m: float | None = None
    dem: str | None = None
    vertical: str | None = None
    geoid: str | None = None
    dem_sigma_m: float | None = None
    dem_frame_sigma_m: float | None = None
    exclude: tuple[str, ...] = ()
    exclude_heights: tuple[str, ...] = ()
    land_cover: str | None = None
    required: RequiredQuality = field(default_factory=RequiredQuality)


def _check(connection: Connection, caller: Token, inputs: AssessBlock) -> None:
    """Check the inputs but not the files, which may lie on a disk that only the worker has."""
    lifecycle.find_shown_block(connection, inputs.block)
    if inputs.dem is None and (
        inputs.vertical or inputs.geoid or inputs.exclude_heights or inputs.land_cover
    ):
        raise InputError(
            "vertical, geoid, exclude_heights, land_cover: given without dem, whose heights they "
            "describe; add dem, or leave them out"
        )
    for name in ("site_sigma_m", "search_m", "dem_sigma_m", "dem_frame_sigma_m"):
        value = getattr(inputs, name)
        if value is not None and not value > 0.0:
            raise InputError(f"{name}: {value:g} found, more than 0 m expected")
    if inputs.vertical is not None:
        with naming("vertical"):
            vertical_crs(inputs.vertical)


def _run(work: Work) -> Commit:
    """Assess a block and put the report into the storage; no transaction is open meanwhile."""
    inputs: AssessBlock = work.inputs
    references = _references(work.settings.reference_folder, inputs)
    report = assess_stored(
        work.database, work.storage, inputs.block, references, inputs.required, progress=work.progress
    )
    with TemporaryDirectory(prefix="amers-quality-") as scratch:
        keys = store_results(work, write_quality_files(report, Path(scratch)))

    def commit(connection: Connection) -> dict[str, Any]:
        return {"specification": report.verdict, "words": report.verdict_words, "files": keys}

    return commit


def _references(folder: Path | None, inputs: AssessBlock) -> QualityReferences:
    """The references of the inputs as files on this machine.

    Raises:
        InputError: AMERS_REFERENCE_FOLDER is not set, or a path does not lead to a file below it.
    """

    def file(name: str, path: str) -> Path:
        if folder is None:
            raise InputError(f"{name}: no file can be used, because AMERS_REFERENCE_FOLDER is not set")
        return file_below(folder, path, name, "AMERS_REFERENCE_FOLDER")

    def files(name: str, paths: tuple[str, ...]) -> tuple[Path, ...]:
        return tuple(file(name, path) for path in paths)

    heights = None
    if inputs.dem is not None:
        geoid = None if inputs.geoid is None else file("geoid", inputs.geoid)
        cover = None if inputs.land_cover is None else file("land_cover", inputs.land_cover)
        heights = HeightFiles(
            TerrainFile(file("dem", inputs.dem), inputs.vertical, geoid, is_uploaded=True),
            inputs.dem_sigma_m,
            inputs.dem_frame_sigma_m,
            files("exclude_heights", inputs.exclude_heights),
            cover,
        )
    return QualityReferences(
        heights=heights,
        sites=(
            *(SiteFile(path) for path in files("sites", inputs.sites)),
            *(SiteFile(path, True) for path in files("control_sites", inputs.control_sites)),
        ),
        site_sigma_m=inputs.site_sigma_m,
        reach_m=inputs.search_m,
        excluded=files("exclude", inputs.exclude),
    )


ASSESS_BLOCK = Process(
    id="assess-block",
    title="Assess the quality of a block",
    description="Measure density, planimetry and heights of a block against references on the server.",
    scope=Scope.ADMIN,
    inputs=AssessBlock,
    outputs={
        DOCUMENT: "The report, as the schema /schemas/block_quality.json describes it.",
        PAGE: "The report as a page.",
    },
    check=_check,
    run=_run,
    values={
        "specification": {
            "enum": list(get_args(BlockVerdict)),
            "title": "Whether the block meets its specification",
        },
        "words": {"type": "string", "title": "The same as a sentence"},
    },
)
