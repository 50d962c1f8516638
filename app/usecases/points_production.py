"""Make a block of the points of another base: read them, give them chips, write the folder."""

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from amers.app.errors import InputError
from amers.app.usecases.model_choice import ModelChoice
from amers.app.usecases.new_block import (
    BlockIdentity,
    block_metadata,
    fewest_views,
    image_accuracy,
    refuse_existing,
)
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.datums import filled_sigmas
from amers.services.errors import refuse_unstated
from amers.services.formats.block.document import AccuracyFigure, BlockMetadata, BlockSpecification
from amers.services.formats.block.writer import write_block
from amers.services.formats.gcp.base_chips import open_base_chip, read_base_chips
from amers.services.formats.gcp.reader import (
    StatedByCaller,
    ground_points,
    read_or_missing,
    read_used_points,
)
from amers.services.formats.images.bands import parse_bands
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.marks import check_marks_inside, check_not_exchanged
from amers.services.imagery.scene import Scene
from amers.services.production.points_production import (
    KnownPointOptions,
    KnownPoints,
    check_sigmas,
    produce_known_points,
)
from amers.services.production.points_with_chips import OwnChips, produce_points_with_chips
from amers.services.sensors.rpc import RpcModel
from amers.services.statements import gathered
from amers.services.types import Frame, GroundPoints, Progress, no_progress, part_of


@dataclass(frozen=True)
class KnownPointFiles:
    """Points of another base in a file, and the images or the folder that give them chips.

    Attributes:
        points: file of the points: GCPLib, Copernicus GCP database, CSV, ASP, OPF, GeoJSON, ODM, QGIS,
            ENVI, PCI.
        images: image with a registered model, or ortho-image; repeat for several, the most accurate
            first.
        chips: folder of the chips of the base, instead of images; for GCPLib and the Copernicus GCP
            database.
        chip_origin: pixel origin of the chips of GCPLib: centre, corner, centre-1, corner-1.
        stated: what the file of the points does not state.
        point_sigma_m: horizontal and up, one standard deviation, of points whose file states none.
        terrain: gives the heights of points without any.
        height_sigma_m: sigma of the heights of --dem, metres; by default the sigma of each cell of a
            surface, otherwise 0.1 of the grid spacing.
        sigma_m: accuracy of the sensor models of the images, one sigma, metres; by default the accuracy
            that the producer states, or that of the sensor.
        frame_sigma_m: common horizontal error of all points, one sigma, metres; by default unknown.
        frame_sigma_up_m: common vertical error of all points, one sigma, metres; by default unknown.
        bands: bands to use: 2, or 1,2,3, or 3:0.3,2:0.7.
        models: of the images whose names and tags do not give them.
    """

    points: Path
    images: tuple[Path, ...] = ()
    chips: Path | None = None
    chip_origin: str | None = None
    stated: StatedByCaller = field(default_factory=StatedByCaller)
    point_sigma_m: tuple[float, float] | None = None
    terrain: TerrainFile | None = None
    height_sigma_m: float | None = None
    sigma_m: float | None = None
    frame_sigma_m: float | None = None
    frame_sigma_up_m: float | None = None
    bands: str | None = None
    models: ModelChoice = field(default_factory=ModelChoice)


def run_points_production(
    files: KnownPointFiles,
    folder: Path,
    identity: BlockIdentity,
    options: KnownPointOptions = KnownPointOptions(),
    progress: Progress = no_progress,
) -> KnownPoints:
    """Make a block of points of another base and write its folder.

    Args:
        files: the points, and the images or their own chips.
        folder: of the block; must not exist.
        identity: of the block.
        options: of the points.
        progress: receives the fraction done and a message.

    Raises:
        InputError: a file cannot be used, does not state what it must, or the folder exists.
        ComputationError: too few points have chips.
    """
    refuse_existing(folder)
    _check_sources(files, options)
    ground = _ground_points(files)
    frame = Frame.from_sigmas(_or_nan(files.frame_sigma_m), _or_nan(files.frame_sigma_up_m))
    make = part_of(progress, 0.0, 0.8)
    with ExitStack() as stack:
        if files.chips is not None:
            own = _own_chips(files.points, files.chips, files.chip_origin)
            production = produce_points_with_chips(ground, own, frame, make)
            production = replace(production, statements=gathered(ground.statements))
        else:
            bands = None if files.bands is None else parse_bands(files.bands)
            scenes = []
            for image, (model, origin) in files.models.of(files.images).items():
                scenes.append(
                    read_scene(image, model, sigma_m=files.sigma_m, bands=bands, crop_origin=origin)
                )
                stack.callback(scenes[-1].image.close)  # type: ignore[attr-defined]
            _check_on_scenes(files, scenes)
            production = produce_known_points(ground, scenes, frame, options, make)
            stated = chain(ground.statements, *(scene.statements for scene in scenes))
            production = replace(production, statements=gathered(stated))
        models = {
            scene.acquisition.image_id: scene.model
            for scene in production.scenes
            if isinstance(scene.model, RpcModel)
        }
        write_block(
            folder,
            _metadata(files, identity, production, options),
            production.points,
            production.chips,
            models,
            progress=part_of(progress, 0.8, 0.2),
        )
    return production


def _check_sources(files: KnownPointFiles, options: KnownPointOptions) -> None:
    """Refuse images and chips together, neither of them, and options of the other one."""
    if bool(files.images) == (files.chips is not None):
        raise InputError(
            f"{files.points.name}: either images that show its points (--images) or the folder of its "
            "own chips (--chips) is expected"
        )
    of_images = (files.sigma_m, files.bands, options.fine_gsd_m)
    if files.chips is not None and of_images != (None, None, None):
        raise InputError(
            f"{files.points.name}: --sigma-m, --bands and --gsd-m are for images; with the chips of the "
            "base (--chips), leave them out"
        )
    if files.chips is None and files.chip_origin is not None:
        raise InputError(f"{files.points.name}: --chip-origin is for --chips; leave it out")


def _own_chips(points: Path, folder: Path, origin: str | None) -> OwnChips:
    chips = read_base_chips(points, folder, origin)
    images = {chip.acquisition.image_id: chip.acquisition for chip in chips}
    number = {name: row for row, name in enumerate(images)}
    return OwnChips(
        point_id=np.array([chip.point_id for chip in chips], dtype=np.str_),
        image=np.array([number[chip.acquisition.image_id] for chip in chips], dtype=np.int64),
        images=tuple(images.values()),
        open=lambda k: open_base_chip(chips[k]),
    )


def _metadata(
    files: KnownPointFiles, identity: BlockIdentity, production: KnownPoints, options: KnownPointOptions
) -> BlockMetadata:
    points = production.points
    stated: dict[str, Any] = {"points": files.points.name, "left_out": production.left_out}
    if files.chips is None:
        chips = f"from {len(production.scenes)} images"
        accuracy = image_accuracy(points, production.local_sigma_m, len(production.scenes))
        stated = asdict(options) | stated
    else:
        chips = "of the base itself"
        frame_m = points.frames[0].sigma_m
        of_base = "the stated accuracy of the base, not measured"
        accuracy = ()
        if math.isfinite(frame_m):
            accuracy = (AccuracyFigure("absolute", "frame_sigma_m", frame_m, len(points), of_base),)
        if files.chip_origin is not None:
            stated["chip_origin"] = files.chip_origin
    return block_metadata(
        identity,
        points.views.images,
        points,
        description=f"{len(points)} points of {files.points.name}, chips {chips}",
        outline=production.outline,
        specification=BlockSpecification(production.gsds_m, fewest_views(points), None),
        options=stated,
        accuracy=accuracy,
    )


def _ground_points(files: KnownPointFiles) -> GroundPoints:
    """The points of the file, with heights and sigmas where they are stated elsewhere."""
    used, unstated = read_or_missing(read_used_points, files.points, files.stated)
    ground = ground_points(used)
    sigma_m = ground.sigma_m
    missing = np.isnan(ground.lon_lat_h[:, 2])
    if files.point_sigma_m is not None:
        sigma_m = filled_sigmas(sigma_m, files.point_sigma_m, ground.datum_sigma_m)
    of_terrain = missing[:, None] & np.array([False, False, files.terrain is not None])
    ground = replace(ground, sigma_m=sigma_m)
    try:
        check_sigmas(replace(ground, sigma_m=np.where(of_terrain, 1.0, sigma_m)))
    except InputError as error:
        unstated.append(error)
    if missing.any() and files.terrain is None:
        unstated.append(
            InputError(
                f"{files.points.name}: {int(missing.sum())} of {len(ground)} points, such as "
                f"{ground.id[missing][0]}, have no height: give a terrain (--dem FILE)"
            )
        )
    refuse_unstated(unstated)
    if not missing.any() or files.terrain is None:
        return ground
    terrain = read_terrain(files.terrain, files.height_sigma_m)
    lon_lat_h = ground.lon_lat_h.copy()
    lon_lat_h[missing, 2] = terrain.height_m(lon_lat_h[missing, :2])
    sigma_m = sigma_m.copy()
    sigma_m[missing, 2] = terrain.sigma_m(lon_lat_h[missing, :2])
    statements = ground.statements + terrain.statements
    return replace(ground, lon_lat_h=lon_lat_h, sigma_m=sigma_m, statements=statements)


def _check_on_scenes(files: KnownPointFiles, scenes: Sequence[Scene]) -> None:
    """Refuse marks of the points outside the images, and latitude and longitude exchanged."""
    marks = read_used_points(files.points, files.stated)
    check_not_exchanged(marks.lon_lat_h, scenes, files.points.name)
    for scene, path in zip(scenes, files.images, strict=True):
        names = [path.name.lower(), path.stem.lower(), scene.acquisition.image_id.lower()]
        own = marks.take(marks.is_marked & np.isin(np.char.lower(marks.image), names))
        shape = np.tile(scene.image.shape, (len(own), 1))
        check_marks_inside(own.line_sample, own.id, own.image, shape, files.points.name)


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
