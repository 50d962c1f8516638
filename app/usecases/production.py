"""Make a block of points from ortho-images; what all blocks of points state of themselves."""

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from amers.app.errors import InputError
from amers.app.usecases.terrain_file import HEIGHT_SIGMA_POSTINGS, TerrainFile, read_terrain
from amers.services.formats.block.document import (
    AccuracyFigure,
    BlockMetadata,
    BlockSpecification,
    Provenance,
)
from amers.services.formats.block.writer import write_block
from amers.services.formats.images.bands import parse_bands
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.scene import Scene
from amers.services.production.from_ortho import (
    GroundHeights,
    OrthoPointOptions,
    OrthoPoints,
    produce_ortho_points,
)
from amers.services.types import Acquisition, Array, ControlPoints, Progress, no_progress, part_of


@dataclass(frozen=True)
class BlockIdentity:
    """Name, version, title and licence of a new block.

    Attributes:
        id: a letter, then letters, digits, dots, dashes or underscores.
        version: of the block; a changed block needs a new version.
        title: for people; by default the id.
        license: of the points and chips, an SPDX identifier or "proprietary".
    """

    id: str
    version: str = "1"
    title: str = ""
    license: str = "proprietary"


@dataclass(frozen=True)
class OrthoFiles:
    """Ortho-images in files, and the heights of their ground.

    Attributes:
        images: GeoTIFF (or COG) or JPEG 2000 on a map, of one place; the most accurate first.
        terrain: heights of the ground; None takes `flat_m` everywhere.
        flat_m: height of flat ground, metres above the ellipsoid.
        height_sigma_m: one standard deviation of the heights, metres; required with `flat_m`.
        sigma_m: accuracy of the images on the map, metres; by default that of their sensors.
        frame_sigma_up_m: error that all the heights share, one standard deviation, metres; None when
            unknown.
        bands: see `amers.services.formats.images.bands.parse_bands`.
        mask: image of the same ground; points are avoided where it is not zero.
    """

    images: tuple[Path, ...]
    terrain: TerrainFile | None = None
    flat_m: float | None = None
    height_sigma_m: float | None = None
    sigma_m: float | None = None
    frame_sigma_up_m: float | None = None
    bands: str | None = None
    mask: Path | None = None


def run_ortho_production(
    files: OrthoFiles,
    folder: Path,
    identity: BlockIdentity,
    options: OrthoPointOptions = OrthoPointOptions(),
    progress: Progress = no_progress,
) -> OrthoPoints:
    """Make a block of points from ortho-images of one place and write its folder.

    Args:
        files: the images and their heights.
        folder: of the block; must not exist.
        identity: of the block.
        options: of the points.
        progress: receives the fraction done and a message.

    Raises:
        InputError: an image or the heights cannot be used, or the folder exists.
        ComputationError: too little of the first image makes points that the others show too.
    """
    refuse_existing(folder)
    heights = _ground_heights(files)
    bands = None if files.bands is None else parse_bands(files.bands)
    with ExitStack() as stack:
        scenes = []
        for image in files.images:
            scenes.append(read_scene(image, sigma_m=files.sigma_m, bands=bands, mask=files.mask))
            stack.callback(scenes[-1].image.close)  # type: ignore[attr-defined]
        production = produce_ortho_points(scenes, heights, options, part_of(progress, 0.0, 0.7))
        write_block(
            folder,
            _ortho_metadata(identity, scenes, production, options),
            production.points,
            production.chips,
            {},
            progress=part_of(progress, 0.7, 0.3),
        )
    return production


def _ground_heights(files: OrthoFiles) -> GroundHeights:
    frame_sigma_m = math.nan if files.frame_sigma_up_m is None else files.frame_sigma_up_m
    if (files.terrain is None) == (files.flat_m is None):
        raise InputError(
            "heights of the ground: either a terrain (--dem) or one flat height (--height-m) is expected"
        )
    if files.terrain is not None:
        terrain = read_terrain(files.terrain)
        sigma_m = files.height_sigma_m or HEIGHT_SIGMA_POSTINGS * terrain.posting_m
        return GroundHeights(terrain, 0.0, sigma_m, frame_sigma_m)
    if files.flat_m is None or files.height_sigma_m is None:
        raise InputError("one flat height: its standard deviation (--height-sigma-m) is missing")
    return GroundHeights(None, files.flat_m, files.height_sigma_m, frame_sigma_m)


def refuse_existing(folder: Path) -> None:
    """Refuse a folder that exists.

    Raises:
        InputError: it exists.
    """
    if folder.exists():
        raise InputError(f"{folder}: already exists; a block is written into a new folder")


def _ortho_metadata(
    identity: BlockIdentity, scenes: Sequence[Scene], production: OrthoPoints, options: OrthoPointOptions
) -> BlockMetadata:
    n_points = len(production.points)
    n_images = f"{len(scenes)} ortho-images" if len(scenes) > 1 else "one ortho-image"
    return block_metadata(
        identity,
        [scene.acquisition for scene in scenes],
        production.points,
        description=f"{n_points} ground control points with chips, from {n_images}",
        outline=production.outline,
        specification=BlockSpecification(
            gsds_m=production.gsds_m,
            min_views=fewest_views(production.points),
            points_per_km2=points_per_km2(options.spacing_m),
        ),
        options=asdict(options),
        accuracy=image_accuracy(production.points, production.local_sigma_m, len(scenes)),
    )


def fewest_views(points: ControlPoints) -> int:
    """The smallest number of images that show a point."""
    views = points.views
    of_point = np.repeat(np.arange(len(points)), np.diff(views.start))
    pairs = np.unique(np.column_stack([of_point, views.image]), axis=0)
    return int(np.bincount(pairs[:, 0]).min())


def image_accuracy(
    points: ControlPoints, local_sigma_m: float, n_images: int
) -> tuple[AccuracyFigure, ...]:
    """The stated accuracies of points whose position is that of images.

    Args:
        points: of the block.
        local_sigma_m: error of details relative to the rest of their image, from the disagreement of
            images; NaN where nothing shows it.
        n_images: number of images.
    """
    frame_sigma_m = points.frames[0].sigma_m
    figures = []
    if math.isfinite(local_sigma_m):
        disagreement = "the disagreement of the images, after one shift of each"
        figures = [AccuracyFigure("relative", "local_sigma_m", local_sigma_m, len(points), disagreement)]
    if math.isfinite(frame_sigma_m):
        stated = (
            "the stated accuracy of the first image, not measured; raised where images disagree by more"
        )
        if n_images == 1:
            stated = "the stated accuracy of the image, not measured"
        figures.append(AccuracyFigure("absolute", "frame_sigma_m", frame_sigma_m, n_images, stated))
    return tuple(figures)


def block_metadata(
    identity: BlockIdentity,
    images: Sequence[Acquisition],
    points: ControlPoints,
    *,
    description: str,
    outline: Array,
    specification: BlockSpecification,
    options: dict[str, Any],
    accuracy: tuple[AccuracyFigure, ...],
) -> BlockMetadata:
    """What a block states of itself: its identity, images, outline, specification and accuracy."""
    dates = [image.acquired_at for image in images if image.acquired_at is not None]
    return BlockMetadata(
        id=identity.id,
        version=identity.version,
        title=identity.title or identity.id,
        description=description,
        license=identity.license,
        extent=outline,
        created=datetime.now(UTC),
        specification=specification,
        provenance=Provenance(
            software="amers",
            version=version("amers"),
            sources=tuple(image.image_id for image in images),
            options=options,
        ),
        epoch=None if not dates else _decimal_year(max(dates)),
        accuracy=accuracy,
        frame=points.frames[0],
    )


def points_per_km2(spacing_m: float | None) -> float | None:
    """Density of one point for each square of a side in metres."""
    return None if spacing_m is None else (spacing_m / 1000.0) ** -2.0


def _decimal_year(moment: datetime) -> float:
    start = datetime(moment.year, 1, 1, tzinfo=UTC)
    end = datetime(moment.year + 1, 1, 1, tzinfo=UTC)
    return round(moment.year + (moment - start) / (end - start), 3)
