"""Straighten a scene whose lines or samples moved: for the command line, and as a process."""

from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

import numpy as np

from amers.app.auth import Scope
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.errors import InputError
from amers.app.usecases.damage import suspecting_damage
from amers.app.usecases.orthorectification import DataPixels, pixel_type
from amers.app.usecases.processes import STATEMENTS_VALUE, Commit, Process, Work, stated_document
from amers.app.usecases.registered_scene import delivered_and_correction
from amers.app.usecases.results import store_results
from amers.app.usecases.scene_inputs import check_file_names, check_scene, registered_model_keys
from amers.app.usecases.stored_scenes import local_scene, stored_scenes
from amers.services.errors import CoverageError
from amers.services.formats.images.bands import one_band
from amers.services.formats.images.ortho import BandForm, SensorGrid, write_cog
from amers.services.formats.images.raster import RasterImage
from amers.services.formats.images.tiled_image import TiledImage
from amers.services.formats.sensor_models.rpc_files import ImageFiles
from amers.services.map_grid import MapGrid
from amers.services.orthorectification.straighten import straighten, without_displacement
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel, ImageCorrection
from amers.services.sensors.ortho import OrthoModel, fold_into_ortho
from amers.services.sensors.refined import refined_rpc
from amers.services.statements import Statements, Subject, gathered
from amers.services.types import Progress, no_progress

STRAIGHTENED_NAME = "straightened.tif"


@dataclass(frozen=True)
class StraightenedScene:
    """A straightened image that was written.

    Attributes:
        path: of the image, with its model in its tags.
        lines, samples, bands: its size.
        largest_px: by which a pixel was moved, at most.
        seen: share of its pixels that have data.
        model: the RPC or the map grid in its tags, and how close it is.
        statements: of the files of the scene.
    """

    path: Path
    lines: int
    samples: int
    bands: int
    largest_px: float
    seen: float
    model: str
    statements: Statements = ()


@dataclass(frozen=True)
class StraightenScene:
    """The inputs of a process that straightens a scene.

    Attributes:
        scene: id of an uploaded scene.
        registration: id of the job that registered the scene.
        model: name of the uploaded file with the scene's model; by default it is found by its name.
    """

    scene: UUID
    registration: UUID
    model: str | None = None


def run_straightening(
    source: ImageFiles, registration: Path, output: Path, progress: Progress = no_progress
) -> StraightenedScene:
    """Write a scene resampled by the displacement of its correction, with a model that GDAL reads.

    Pixels of 8 or 16 bits and of 32-bit floating point keep their type; others become floating point.

    Args:
        source: the files of the scene.
        registration: folder of its registration.
        output: path of the image; an existing file is replaced.
        progress: receives the fraction done and a message.

    Raises:
        InputError: the scene or its registration cannot be used, or its correction has no displacement.
    """
    if output.resolve() == source.image.resolve():
        raise InputError(f"{output}: the output would replace an input file; choose another name")
    scene, correction = delivered_and_correction(source, registration, one_band(1))
    raster = scene.image
    assert isinstance(raster, RasterImage | TiledImage)
    try:
        if correction.displacement is None:
            raise InputError(
                f"{registration}: the correction is affine, and its refined model carries it; a "
                "correction with a displacement of lines or samples expected: use the image as it is"
            )
        grid, words = _placed(scene.model, correction, raster.shape)
        bands = [raster.with_mix(one_band(band)) for band in raster.validity.image_bands]
        dtype, nodata = pixel_type(raster)
        saturated = next(reversed(raster.saturated_values(1)), None)
        counter = DataPixels(partial(_nothing_shown, source.image))
        windows = counter.count(straighten(bands, correction, progress=progress))
        write_cog(output, grid, windows, BandForm(len(bands), dtype, nodata, saturated))
    finally:
        raster.close()
    lines, samples = raster.shape
    moved_px = np.linalg.norm(correction.displacement.displacement_px, axis=-1)
    return StraightenedScene(
        path=output,
        lines=lines,
        samples=samples,
        bands=len(bands),
        largest_px=float(moved_px.max()),
        seen=counter.pixels / (lines * samples * len(bands)),
        model=words,
        statements=gathered(one for one in scene.statements if one.subject is not Subject.BANDS),
    )


def _nothing_shown(image: Path) -> CoverageError:
    return CoverageError(f"{image}: no pixel has data: the registration belongs to another image")


def _placed(
    model: SensorModel, correction: ImageCorrection, shape: tuple[int, int]
) -> tuple[MapGrid | SensorGrid, str]:
    """The map grid or the RPC of a straightened image, and how close it is.

    Raises:
        InputError: no RPC is close to the model.
    """
    affine = without_displacement(correction)
    if isinstance(model, OrthoModel):
        return fold_into_ortho(model, affine).grid, "a map grid, exactly"
    fitted = refined_rpc(CorrectedModel(model, affine), shape)
    if fitted.model is None:
        raise InputError(
            "no RPC expresses the model of the straightened image: the best-fitting RPC is "
            f"{fitted.max_error_px:.2g} px off; orthorectify the scene instead"
        )
    how = "exactly" if fitted.max_error_px == 0.0 else f"within {fitted.max_error_px:.2g} px"
    return SensorGrid(shape, fitted.model), f"an RPC, {how}"


def _check(connection: Connection, caller: Token, inputs: StraightenScene) -> None:
    check_scene(connection, caller, inputs.scene)
    check_file_names(inputs, "model")
    registered_model_keys(connection, inputs.scene, inputs.registration)


def _run(work: Work) -> Commit:
    """Straighten an uploaded scene and put the image into the storage."""
    inputs: StraightenScene = work.inputs
    with work.database.snapshot() as connection:
        [scene] = stored_scenes(connection, [inputs.scene], [inputs.registration])
    with ExitStack() as stack:
        image, registration = local_scene(work, scene, stack)
        assert registration is not None
        output = Path(stack.enter_context(TemporaryDirectory(prefix="amers-"))) / STRAIGHTENED_NAME
        model = image.with_name(inputs.model) if inputs.model else None
        with suspecting_damage(work.database, work.storage, scene.keys):
            made = run_straightening(ImageFiles(image, model), registration, output, work.progress)
        keys = store_results(work, {STRAIGHTENED_NAME: output})

    def commit(connection: Connection) -> dict[str, Any]:
        return {
            "lines": made.lines,
            "samples": made.samples,
            "largest_px": made.largest_px,
            "seen": made.seen,
            "model": made.model,
            "statements": stated_document(made.statements),
            "files": keys,
        }

    return commit


STRAIGHTEN_SCENE = Process(
    id="straighten-scene",
    title="Straighten a registered scene",
    description="Resample an uploaded scene by the displacements of lines and samples that its "
    "registration measured, so that an RPC expresses its model.",
    scope=Scope.REGISTER,
    inputs=StraightenScene,
    outputs={STRAIGHTENED_NAME: "The scene with its RPC, a cloud-optimised GeoTIFF."},
    check=_check,
    run=_run,
    values={
        "lines": {"type": "integer", "title": "Lines of the image, px"},
        "samples": {"type": "integer", "title": "Samples of the image, px"},
        "largest_px": {"type": "number", "title": "Largest displacement of a pixel, px"},
        "seen": {"type": "number", "title": "Share of the pixels with data"},
        "model": {"type": "string", "title": "The model in the tags, and how close it is"},
        "statements": STATEMENTS_VALUE,
    },
)
