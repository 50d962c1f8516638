"""The process that brings vectors drawn on an uploaded scene onto the map."""

from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

from app.auth import Scope
from app.db import registrations
from app.db.engine import Connection
from app.db.tokens import Token
from app.errors import InputError
from app.usecases.damage import named_by_row, suspecting_damage
from app.usecases.processes import Commit, Process, Work
from app.usecases.registered_scene import REFINED_NAME, SceneModel
from app.usecases.results import store_results
from app.usecases.scene_inputs import check_file_names, check_scene, naming, present_scene
from app.usecases.scenes import local_image, stored_keys
from app.usecases.terrain_file import TerrainFile
from app.usecases.vector_files import VectorFile, VectorOptions, check_options
from app.usecases.vectors import correct_file
from services.formats.elevation.geoid import vertical_crs
from services.formats.sensor_models.refined_model import CORRECTION_JSON
from services.map_grid import check_map_code
from services.quality.accuracy_statement import AccuracyStatement, accuracy_document

VECTORS_NAME, VERTICES_NAME = "vectors.gpkg", "vertices.gpkg"
SUFFIXES = (".geojson", ".json")
"""Formats of uploaded vectors: GeoJSON, of which GDAL gets the features alone. It decides by the content
what a file is, so that one of another format may be a virtual dataset of files that lie here."""


@dataclass(frozen=True)
class CorrectVectors:
    """The inputs of a correction of vectors.

    Attributes:
        scene: id of an uploaded scene.
        vectors: name of the file uploaded beside the image, GeoJSON in pixel coordinates.
        dem: name of the terrain file uploaded beside the image.
        model: name of the uploaded file with the scene's model; by default it is found by its name.
        registration: id of the job that registered the scene; its refined model and accuracy are used.
        sigma_m: accuracy on the Earth of a model that is not registered, one standard deviation of each
            coordinate, metres; null when unknown.
        vertical: vertical datum of the heights, where the terrain file does not state it.
        geoid: name of an uploaded grid file of the geoid.
        fill_px: voids are filled from heights at most this many nodes away.
        crs: code of the reference system of the map; by default the UTM zone of the scene.
        options: of the correction.
    """

    scene: UUID
    vectors: str
    dem: str
    model: str | None = None
    registration: UUID | None = None
    sigma_m: float | None = None
    vertical: str | None = None
    geoid: str | None = None
    fill_px: int = 0
    crs: str | None = None
    options: VectorOptions = field(default_factory=VectorOptions)


def _check(connection: Connection, caller: Token, inputs: CorrectVectors) -> None:
    check_scene(connection, caller, inputs.scene)
    check_file_names(inputs, "vectors", "dem", "model", "geoid")
    if not inputs.vectors.lower().endswith(SUFFIXES):
        raise InputError(f"vectors: {inputs.vectors} found, one of {', '.join(SUFFIXES)} expected")
    if inputs.sigma_m is not None and not inputs.sigma_m > 0.0:
        raise InputError(f"sigma_m: {inputs.sigma_m:g} found, a length above 0 m expected")
    check_options(inputs.options)
    if inputs.crs is not None:
        with naming("crs"):
            check_map_code(inputs.crs)
    if inputs.vertical is not None:
        with naming("vertical"):
            vertical_crs(inputs.vertical)
    if inputs.registration is not None:
        _registration_keys(connection, inputs.scene, inputs.registration)


def _registration_keys(connection: Connection, scene_id: UUID, job_id: UUID) -> list[str]:
    """The storage keys of the correction and the refined model that a job made of a scene.

    Raises:
        InputError: the job did not register the scene.
    """
    registration = registrations.find_by_job(connection, job_id)
    if registration is None or registration.scene_id != scene_id:
        raise InputError(f"registration: job {job_id} did not register scene {scene_id}")
    names = (CORRECTION_JSON, REFINED_NAME)
    keys = [registration.files[name] for name in names if name in registration.files]
    if CORRECTION_JSON not in registration.files:
        raise InputError(f"registration: job {job_id} made no {CORRECTION_JSON}")
    return keys


def _run(work: Work) -> Commit:
    """Correct uploaded vectors and put them into the storage, with a file of their vertices."""
    inputs: CorrectVectors = work.inputs
    with work.database.snapshot() as connection:
        scene = present_scene(connection, inputs.scene)
        keys = []
        if inputs.registration is not None:
            keys = _registration_keys(connection, inputs.scene, inputs.registration)
    with TemporaryDirectory(prefix="amers-") as scratch, TemporaryDirectory(prefix="amers-") as made:
        image = local_image(work.storage, work.settings, scene, Path(scratch))
        folder = Path(made)
        registration = None
        for key in keys:
            with named_by_row(key):
                registration = work.storage.fetch(key, folder).parent
        work.progress(0.1, "correcting the vectors")
        with suspecting_damage(work.database, work.storage, [*stored_keys(scene), *keys]):
            corrected = correct_file(
                VectorFile(image.with_name(inputs.vectors)),
                SceneModel(
                    image,
                    image.with_name(inputs.model) if inputs.model else None,
                    registration,
                    inputs.sigma_m,
                ),
                TerrainFile(
                    image.with_name(inputs.dem),
                    inputs.vertical,
                    image.with_name(inputs.geoid) if inputs.geoid else None,
                    inputs.fill_px,
                ),
                folder / VECTORS_NAME,
                crs=inputs.crs,
                vertices=folder / VERTICES_NAME,
                options=inputs.options,
            )
        stored = store_results(work, {name: folder / name for name in (VECTORS_NAME, VERTICES_NAME)})
    statement = AccuracyStatement(corrected.relative_to_control_points, corrected.on_the_earth)

    def commit(connection: Connection) -> dict[str, Any]:
        return {
            "features": corrected.features,
            "vertices": corrected.vertices,
            "added_vertices": corrected.added_vertices,
            "left_out": list(corrected.left_out),
            **accuracy_document(statement),
            "files": stored,
        }

    return commit


CORRECT_VECTORS = Process(
    id="correct-vectors",
    title="Correct vectors",
    description="Bring vectors that were drawn on an uploaded scene onto the map, by its model and a "
    "terrain uploaded beside it, with the predicted accuracy of every vertex.",
    scope=Scope.REGISTER,
    inputs=CorrectVectors,
    outputs={
        VECTORS_NAME: "The vectors on the map, with the accuracy of the worst vertex of each feature.",
        VERTICES_NAME: "Every vertex as a point, with its image position and its accuracy.",
    },
    check=_check,
    run=_run,
    values={
        "features": {"type": "integer", "title": "Features on the map"},
        "vertices": {"type": "integer", "title": "Their vertices"},
        "added_vertices": {"type": "integer", "title": "Vertices added where the ground bends edges"},
        "left_out": {
            "type": "array",
            "items": {"type": "integer"},
            "title": "Numbers of the features, from 1, that meet no ground",
        },
        "relative_to_control_points": {
            "type": "object",
            "title": "Accuracy relative to the control points",
        },
        "on_the_earth": {"type": "object", "title": "Accuracy on the Earth"},
    },
)
