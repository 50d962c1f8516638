"""The processes that bring vectors drawn on an uploaded scene onto the map, and back."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args
from uuid import UUID

from amers.app.auth import Scope
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.errors import InputError
from amers.app.usecases.damage import named_by_row, suspecting_damage
from amers.app.usecases.processes import (
    STATEMENTS_VALUE,
    Commit,
    Process,
    Work,
    stated_document,
)
from amers.app.usecases.registered_scene import SceneModel
from amers.app.usecases.results import store_results
from amers.app.usecases.scene_inputs import (
    check_file_names,
    check_scene,
    naming,
    present_scene,
    registered_model_keys,
)
from amers.app.usecases.scenes import local_image, stored_keys
from amers.app.usecases.terrain_file import TerrainFile
from amers.app.usecases.vector_files import (
    CorrectionOptions,
    ProjectionOptions,
    VectorFile,
    VectorOptions,
    check_options,
)
from amers.app.usecases.vectors import correct_file, project_file
from amers.services.formats.elevation.geoid import vertical_crs
from amers.services.map_grid import check_map_code
from amers.services.quality.accuracy_statement import AccuracyStatement, accuracy_document

Format = Literal["gpkg", "geojson"]
SUFFIXES = (".geojson", ".json")
"""Formats of uploaded vectors: GeoJSON, of which GDAL gets the features alone. It decides by the content
what a file is, so that one of another format may be a virtual dataset of files that lie here."""


@dataclass(frozen=True)
class VectorInputs:
    """The inputs of both processes.

    Attributes:
        scene: id of an uploaded scene.
        vectors: name of the GeoJSON file uploaded beside the image.
        dem: name of the terrain file uploaded beside the image.
        model: name of the uploaded file with the scene's model; by default it is found by its name.
        registration: id of the job that registered the scene; its refined model and accuracy are used.
        vertical: vertical datum of the heights, where the terrain file does not state it.
        geoid: name of an uploaded grid file of the geoid.
        fill_px: voids are filled from heights at most this many nodes away.
        format: format of the outputs, "gpkg" or "geojson".
    """

    scene: UUID
    vectors: str
    dem: str
    model: str | None = None
    registration: UUID | None = None
    vertical: str | None = None
    geoid: str | None = None
    fill_px: int = 0
    format: Format = "gpkg"


@dataclass(frozen=True)
class CorrectVectors(VectorInputs):
    """The inputs of a correction of vectors.

    Attributes:
        vectors: name of the file uploaded with the image, GeoJSON in pixel coordinates.
        sigma_m: accuracy on the Earth of a model that is not registered, one standard deviation per
            coordinate, metres; null if unknown.
        crs: code of the reference system of the map; by default the UTM zone of the scene, or longitude
            and latitude for GeoJSON.
        options: of the correction.
    """

    sigma_m: float | None = None
    crs: str | None = None
    options: CorrectionOptions = field(default_factory=CorrectionOptions)


@dataclass(frozen=True)
class ProjectVectors(VectorInputs):
    """The inputs of a projection of vectors.

    Attributes:
        vectors: name of the file uploaded with the image, GeoJSON in longitude and latitude, or in the
            reference system that the file names.
        options: of the projection.
    """

    options: ProjectionOptions = field(default_factory=ProjectionOptions)


@dataclass(frozen=True)
class _Files:
    """The files of a job on this machine.

    Attributes:
        vectors, scene, terrain: that it reads.
        made: by the names of the outputs, the paths of the vectors and of their vertices.
    """

    vectors: VectorFile
    scene: SceneModel
    terrain: TerrainFile
    made: dict[str, Path]


def _check(connection: Connection, caller: Token, inputs: VectorInputs, options: VectorOptions) -> None:
    """Refuse what both processes cannot use."""
    check_scene(connection, caller, inputs.scene)
    check_file_names(inputs, "vectors", "dem", "model", "geoid")
    if not inputs.vectors.lower().endswith(SUFFIXES):
        raise InputError(f"vectors: {inputs.vectors} found, one of {', '.join(SUFFIXES)} expected")
    check_options(options)
    if inputs.vertical is not None:
        with naming("vertical"):
            vertical_crs(inputs.vertical)
    if inputs.registration is not None:
        registered_model_keys(connection, inputs.scene, inputs.registration)


def _check_correction(connection: Connection, caller: Token, inputs: CorrectVectors) -> None:
    _check(connection, caller, inputs, inputs.options)
    if inputs.sigma_m is not None and not inputs.sigma_m > 0.0:
        raise InputError(f"sigma_m: {inputs.sigma_m:g} found, a length above 0 m expected")
    if inputs.crs is not None:
        with naming("crs"):
            check_map_code(inputs.crs)


def _check_projection(connection: Connection, caller: Token, inputs: ProjectVectors) -> None:
    _check(connection, caller, inputs, inputs.options)


@contextmanager
def _files(work: Work, sigma_m: float | None = None) -> Iterator[_Files]:
    """The files of a job, until the context closes; damage of stored ones is looked for on an error."""
    inputs: VectorInputs = work.inputs
    with work.database.snapshot() as connection:
        scene = present_scene(connection, inputs.scene)
        keys = []
        if inputs.registration is not None:
            keys = registered_model_keys(connection, inputs.scene, inputs.registration)
    with TemporaryDirectory(prefix="amers-") as scratch, TemporaryDirectory(prefix="amers-") as folder:
        image = local_image(work.storage, work.settings, scene, Path(scratch))
        registration = None
        for key in keys:
            with named_by_row(key):
                registration = work.storage.fetch(key, Path(folder)).parent
        model = image.with_name(inputs.model) if inputs.model else None
        geoid = image.with_name(inputs.geoid) if inputs.geoid else None
        names = (f"{kind}.{inputs.format}" for kind in ("vectors", "vertices"))
        with suspecting_damage(work.database, work.storage, [*stored_keys(scene), *keys]):
            yield _Files(
                VectorFile(image.with_name(inputs.vectors)),
                SceneModel(image, model, registration, sigma_m),
                TerrainFile(
                    image.with_name(inputs.dem),
                    inputs.vertical,
                    geoid,
                    inputs.fill_px,
                    is_uploaded=True,
                ),
                {name: Path(folder) / name for name in names},
            )


def _correct(work: Work) -> Commit:
    """Correct uploaded vectors and put them into the storage, with a file of their vertices."""
    inputs: CorrectVectors = work.inputs
    with _files(work, inputs.sigma_m) as files:
        work.progress(0.1, "correcting the vectors")
        output, vertices = files.made.values()
        corrected = correct_file(
            files.vectors,
            files.scene,
            files.terrain,
            output,
            crs=inputs.crs,
            vertices=vertices,
            options=inputs.options,
        )
        stored = store_results(work, files.made)
    statement = AccuracyStatement(corrected.relative_to_control_points, corrected.on_the_earth)

    def commit(connection: Connection) -> dict[str, Any]:
        return {
            "features": corrected.features,
            "vertices": corrected.vertices,
            "added_vertices": corrected.added_vertices,
            "left_out": list(corrected.left_out),
            "unusable": {str(number): why for number, why in corrected.unusable.items()},
            "renamed": corrected.renamed,
            "statements": stated_document(corrected.statements),
            **accuracy_document(statement),
            "files": stored,
        }

    return commit


def _project(work: Work) -> Commit:
    """Project uploaded vectors and put them into the storage, with a file of their vertices."""
    inputs: ProjectVectors = work.inputs
    with _files(work) as files:
        work.progress(0.1, "projecting the vectors")
        output, vertices = files.made.values()
        projected = project_file(
            files.vectors,
            files.scene,
            files.terrain,
            output,
            vertices=vertices,
            options=inputs.options,
        )
        stored = store_results(work, files.made)

    def commit(connection: Connection) -> dict[str, Any]:
        return {
            "features": projected.features,
            "vertices": projected.vertices,
            "added_vertices": projected.added_vertices,
            "hidden_vertices": projected.hidden_vertices,
            "outside": projected.outside,
            "left_out": list(projected.left_out),
            "unusable": {str(number): why for number, why in projected.unusable.items()},
            "renamed": projected.renamed,
            "statements": stated_document(projected.statements),
            "files": stored,
        }

    return commit


def _outputs(vectors: str, vertices: str) -> dict[str, str]:
    """Descriptions of the outputs, in either format."""
    described = {"vectors": vectors, "vertices": vertices}
    return {f"{kind}.{suffix}": text for suffix in get_args(Format) for kind, text in described.items()}


_COUNTS: dict[str, dict[str, Any]] = {
    "features": {"type": "integer", "title": "Features that were written"},
    "vertices": {"type": "integer", "title": "Their vertices"},
    "added_vertices": {"type": "integer", "title": "Vertices added where edges are bent"},
    "left_out": {
        "type": "array",
        "items": {"type": "integer"},
        "title": "Numbers of the features, from 1, whose lines of sight do not meet the terrain",
    },
    "unusable": {
        "type": "object",
        "title": "Reasons why features, by their numbers from 1, cannot be used and were left out",
    },
    "renamed": {
        "type": "object",
        "title": "Attributes with a name that the format reserves, each with its new name",
    },
    "statements": STATEMENTS_VALUE,
}

CORRECT_VECTORS = Process(
    id="correct-vectors",
    title="Correct vectors",
    description="Transform vectors drawn on an uploaded scene to the map, with its sensor model "
    "and a terrain that was uploaded with the scene. Every vertex gets a predicted accuracy.",
    scope=Scope.REGISTER,
    inputs=CorrectVectors,
    outputs=_outputs(
        "The vectors on the map, with the accuracy of the worst vertex of each feature.",
        "Every vertex as a point, with its image position and its accuracy.",
    ),
    check=_check_correction,
    run=_correct,
    values={
        **_COUNTS,
        "relative_to_control_points": {
            "type": "object",
            "title": "Accuracy relative to the control points",
        },
        "on_the_earth": {"type": "object", "title": "Accuracy on the Earth"},
    },
)

PROJECT_VECTORS = Process(
    id="project-vectors",
    title="Project vectors",
    description="Transform vectors of the map to pixel coordinates of an uploaded scene, with "
    "its sensor model and a terrain that was uploaded with the scene, and mark hidden vertices.",
    scope=Scope.REGISTER,
    inputs=ProjectVectors,
    outputs=_outputs(
        "The vectors in pixel coordinates, with the share of the hidden vertices of each feature.",
        "Every vertex as a point, with its ground position and whether it is hidden.",
    ),
    check=_check_projection,
    run=_project,
    values={
        **_COUNTS,
        "hidden_vertices": {"type": "integer", "title": "Vertices that are hidden by other ground"},
        "outside": {"type": "integer", "title": "Features that the scene does not show"},
    },
)
