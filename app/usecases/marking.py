"""Marks in a scene while a person sets them: adjusted at once, with the positions that follow."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from amers.app.config import Settings
from amers.app.db import references
from amers.app.db.engine import Database
from amers.app.db.jobs.jobs import Job
from amers.app.errors import DamagedFile, InputError
from amers.app.storage import Storage
from amers.app.usecases.marked_files import PointStatements
from amers.app.usecases.references import reference_files
from amers.app.usecases.registration.control_marks import MarkFiles, MarksOfScene, marks_to_adjust
from amers.app.usecases.results import ResultFile, file_bytes, result_key
from amers.app.usecases.scene_model import MODEL_NAME
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.errors import CoverageError, FormatError
from amers.services.formats.gcp.marked_points import marked_points
from amers.services.formats.sensor_models.scene_model import parse_scene_model
from amers.services.imagery.scene import Scene, scene_footprint, scene_gsd_m
from amers.services.lines_of_sight import intersect_terrain
from amers.services.quality.marks import MarkResult
from amers.services.registration.on_marks import register_on_marks
from amers.services.registration.on_points import Registration
from amers.services.sensors.base import SensorModel
from amers.services.sensors.ortho import OrthoModel
from amers.services.terrain import Terrain
from amers.services.types import Array

_MARKS = Path("marks")
"""What messages call the marks of a request."""


@dataclass(frozen=True)
class SetMark:
    """A mark as a person set it.

    Attributes:
        name: of the point.
        line, sample: where the image shows it; the centre of the first pixel is (0, 0).
        lon, lat: of its ground, degrees.
        height_m: above the ellipsoid; None for that of the installation's terrain.
        sigma_m: of its ground, horizontal and up, one standard deviation; None, for both or one of them,
            for that of all marks.
        check: whether it is a check point.
    """

    name: str
    line: float
    sample: float
    lon: float
    lat: float
    height_m: float | None = None
    sigma_m: tuple[float | None, float | None] | None = None
    check: bool = False


@dataclass(frozen=True)
class Place:
    """A place in the image, whose ground is asked for, or on the ground, whose place in the image is.

    Attributes:
        line, sample: in the image; None for a place on the ground.
        lon, lat: of the ground; None for a place in the image.
        height_m: above the ellipsoid; None for that of the terrain, else of the marks.
    """

    line: float | None = None
    sample: float | None = None
    lon: float | None = None
    lat: float | None = None
    height_m: float | None = None


@dataclass(frozen=True)
class FollowedPlace:
    """A place in the image and on the ground, by the adjusted model.

    Attributes:
        line, sample, lon, lat, height_m: NaN where the model or the terrain has none.
        sigma_px: of the place in the image by the model, the larger one of both coordinates.
        is_height_known: whether the height is given or that of the terrain, not that of other marks.
    """

    line: float
    sample: float
    lon: float
    lat: float
    height_m: float
    sigma_px: float
    is_height_known: bool


@dataclass(frozen=True)
class CheckedMark:
    """A check point.

    Attributes:
        mark: as it was set.
        height_m: of its ground.
        sigma_m: (3,) of its ground, east, north, up.
        sigma_px: of the pick.
        residual_px: (2,) observed minus computed; NaN where the model has no position.
        residual_m: the length of it on the ground.
    """

    mark: SetMark
    height_m: float
    sigma_m: Array
    sigma_px: float
    residual_px: Array
    residual_m: float


@dataclass(frozen=True)
class AdjustedMarks:
    """What marks that are being set say.

    Attributes:
        registration: of the scene on them; None without any that is no check point.
        checks: check points.
        places: that were asked for.
        next_place: where one more mark would help most; None without a registration.
        terrain: name of the reference whose terrain gives heights; None where there is none.
    """

    registration: Registration | None
    checks: tuple[CheckedMark, ...]
    places: tuple[FollowedPlace, ...]
    next_place: FollowedPlace | None
    terrain: str | None

    @property
    def results(self) -> tuple[MarkResult, ...]:
        """What became of each mark that is no check point."""
        if self.registration is None or self.registration.marks is None:
            return ()
        return self.registration.marks.marks


def model_of_job(storage: Storage, job: Job) -> Scene:
    """The scene whose model a job read; its image has a size, and no pixels.

    Raises:
        NotFound: the job read no model, or its results were removed.
        DamagedFile: the stored model cannot be read.
    """
    key = result_key(job, MODEL_NAME)
    content = file_bytes(storage, ResultFile(MODEL_NAME, key, "value"))
    try:
        return parse_scene_model(content.decode(), MODEL_NAME)
    except (FormatError, UnicodeDecodeError) as error:
        raise DamagedFile(key, str(error)) from error


@dataclass(frozen=True)
class HeightSource:
    """The terrain of the installation that covers most of a scene.

    Attributes:
        name: of the reference that it is of; None where no reference has one.
        file: of the terrain.
        sigma_m: one standard deviation of its heights; None for that of the terrain.
        outline: (n, 2) lon, lat of the scene; pieces of the terrain that lie apart are left out.
    """

    name: str | None = None
    file: TerrainFile | None = None
    sigma_m: float | None = None
    outline: Array | None = None

    @cached_property
    def terrain(self) -> Terrain | None:
        """The opened terrain."""
        return None if self.file is None else read_terrain(self.file, self.sigma_m, self.outline)


def heights_of_store(database: Database, settings: Settings, scene: Scene) -> HeightSource:
    """The source of heights of an installation for a scene."""
    outline = scene_footprint(scene)
    with database.reading() as connection:
        row = references.best_reference(connection, outline, has_heights=True)
    if row is None or settings.reference_folder is None:
        return HeightSource()
    return HeightSource(row.name, reference_files(settings, row).terrain, row.sigma_up_m, outline)


def adjust_set_marks(
    scene: Scene,
    marks: Sequence[SetMark],
    places: Sequence[Place],
    heights: HeightSource,
    stated: PointStatements,
) -> AdjustedMarks:
    """Register a scene on the marks that a person has set so far, and follow places through its model.

    Args:
        scene: as delivered.
        marks: perhaps none.
        places: in the image or on the ground.
        heights: of the installation.
        stated: sigmas of marks without one, and the frame.

    Raises:
        InputError: a mark cannot be used, or has no height and no terrain does.
    """
    of_scene, check = _of_scene(scene, marks, heights, stated)
    registration = None
    if of_scene is not None and len(of_scene.control):
        registration = register_on_marks(scene, of_scene.control)
    model = scene.model if registration is None else registration.model
    usual_m = sum(model.height_range_m) / 2.0
    if registration is not None:
        usual_m = float(np.median(registration.measures.lon_lat_h[:, 2]))
    asked = list(places)
    if registration is not None and registration.marks is not None:
        following = registration.marks.next_mark
        asked.append(Place(line=following.line, sample=following.sample))
    followed = [_followed(scene, registration, place, heights, usual_m) for place in asked]
    return AdjustedMarks(
        registration,
        _checked(model, check, of_scene),
        tuple(followed[: len(places)]),
        followed[-1] if len(followed) > len(places) else None,
        heights.name,
    )


def _of_scene(
    scene: Scene, marks: Sequence[SetMark], heights: HeightSource, stated: PointStatements
) -> tuple[MarksOfScene | None, list[SetMark]]:
    """The marks with heights and sigmas, and those of them that are check points."""
    if not marks:
        return None, []
    _refuse_without_height(scene, marks, heights)
    sigma_m = np.array([mark.sigma_m or (None, None) for mark in marks], dtype=np.float64)[:, [0, 0, 1]]
    height_m = np.array([mark.height_m for mark in marks], dtype=np.float64)
    read = marked_points(
        [mark.name for mark in marks],
        np.column_stack([[(mark.lon, mark.lat) for mark in marks], height_m]),
        np.array([(mark.line, mark.sample) for mark in marks]),
        sigma_m=sigma_m,
        check=[mark.check for mark in marks],
    )
    files = MarkFiles((_MARKS,), stated, heights.file, heights.sigma_m)
    of_scene = marks_to_adjust([(_MARKS, read)], files, _MARKS, scene, may_lack=True)
    return of_scene, [mark for mark in marks if mark.check]


def _refuse_without_height(scene: Scene, marks: Sequence[SetMark], heights: HeightSource) -> None:
    lacking = [mark.name for mark in marks if mark.height_m is None]
    if lacking and heights.file is None and not isinstance(scene.model, OrthoModel):
        raise InputError(
            f"marks: {lacking[0]} has no height_m, and no reference of this installation has a terrain "
            "there; state its height above the ellipsoid"
        )


def _checked(
    model: SensorModel, marks: Sequence[SetMark], of_scene: MarksOfScene | None
) -> tuple[CheckedMark, ...]:
    """The check points with their residuals."""
    if of_scene is None or of_scene.check is None:
        return ()
    points = of_scene.check
    residual_px = points.line_sample - model.project(points.lon_lat_h)
    planimetric = model.project_derivative(points.lon_lat_h)[:, :, :2]
    seen = np.isfinite(residual_px).all(axis=1)
    residual_m = np.full(len(marks), np.nan)
    solved = np.linalg.solve(planimetric[seen], residual_px[seen][:, :, None])[:, :, 0]
    residual_m[seen] = np.hypot(*solved.T)
    return tuple(
        CheckedMark(
            mark,
            float(points.lon_lat_h[row, 2]),
            points.sigma_m[row],
            float(points.sigma_px[row]),
            residual_px[row],
            float(residual_m[row]),
        )
        for row, mark in enumerate(marks)
    )


def _followed(
    scene: Scene,
    registration: Registration | None,
    place: Place,
    heights: HeightSource,
    usual_m: float,
) -> FollowedPlace:
    """A place in the image and on the ground."""
    model = scene.model if registration is None else registration.model
    if place.line is not None:
        line_sample = np.array([[place.line, place.sample]], dtype=np.float64)
        ground, is_known = _ground_of(model, line_sample, place.height_m, heights, usual_m)
    else:
        lon_lat = np.array([[place.lon, place.lat]], dtype=np.float64)
        height_m, is_known = _height_of(lon_lat, place.height_m, heights, usual_m)
        ground = np.column_stack([lon_lat, [height_m]])
        line_sample = model.project(ground)
    sigma_px = scene.sigma_m / scene_gsd_m(scene)
    if registration is not None and np.isfinite(line_sample).all():
        variances = np.diagonal(registration.adjustment.covariance_at(line_sample)[0])
        sigma_px = float(np.sqrt(variances.max()))
    (line, sample), (lon, lat, height_m) = line_sample[0].tolist(), ground[0].tolist()
    return FollowedPlace(line, sample, lon, lat, height_m, sigma_px, is_known)


def _height_of(
    lon_lat: Array, height_m: float | None, heights: HeightSource, usual_m: float
) -> tuple[float, bool]:
    """The height of a place (1, 2) on the ground, and whether it is known."""
    if height_m is not None:
        return height_m, True
    if heights.terrain is not None:
        of_terrain_m = float(heights.terrain.height_m(lon_lat)[0])
        if np.isfinite(of_terrain_m):
            return of_terrain_m, True
    return usual_m, False


def _ground_of(
    model: SensorModel,
    line_sample: Array,
    height_m: float | None,
    heights: HeightSource,
    usual_m: float,
) -> tuple[Array, bool]:
    """The ground (1, 3) of a place (1, 2) in the image, and whether its height is known."""
    if height_m is None and heights.terrain is not None:
        try:
            ground = intersect_terrain(model, line_sample, heights.terrain)
        except CoverageError:
            ground = np.full((1, 3), np.nan)
        if np.isfinite(ground).all():
            return ground, True
    at_m = usual_m if height_m is None else height_m
    return model.locate(line_sample, np.array([at_m])), height_m is not None
