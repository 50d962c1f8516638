"""Make a block of points from ortho-images: read them and their heights, write the folder."""

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path

from amers.app.errors import InputError
from amers.app.usecases.new_block import (
    BlockIdentity,
    block_metadata,
    fewest_views,
    image_accuracy,
    points_per_km2,
    refuse_existing,
)
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.formats.block.document import BlockMetadata, BlockSpecification
from amers.services.formats.block.writer import write_block
from amers.services.formats.images.bands import parse_bands
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.scene import Scene
from amers.services.production.ortho_production import (
    GroundHeights,
    OrthoPointOptions,
    OrthoPoints,
    produce_ortho_points,
)
from amers.services.statements import gathered
from amers.services.types import Progress, no_progress, part_of


@dataclass(frozen=True)
class OrthoFiles:
    """Ortho-images in files, and the heights of their ground.

    Attributes:
        images: ortho-images, GeoTIFF (or COG) or JPEG 2000; several images of one place, the most
            accurate first.
        terrain: heights of the ground; None takes `flat_m` everywhere.
        flat_m: height of flat ground above the ellipsoid, metres; replaces --dem.
        height_sigma_m: sigma of the heights, metres; by default the sigma of each cell of a surface,
            otherwise 0.1 of the grid spacing.
        sigma_m: accuracy of the ortho-images on the map, one sigma, metres; by default the accuracy of
            their sensors.
        frame_sigma_up_m: common error of all heights, one sigma, metres; by default unknown.
        bands: bands to use: 2, or 1,2,3, or 3:0.3,2:0.7.
        mask: image of the same ground, used as a mask: no points are made where it is not 0.
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
        production = replace(
            produce_ortho_points(scenes, heights, options, part_of(progress, 0.0, 0.7)),
            statements=gathered(chain(*(scene.statements for scene in scenes), heights.statements)),
        )
        write_block(
            folder,
            _ortho_metadata(identity, scenes, production, options),
            production.points,
            production.chips,
            {},
            progress=part_of(progress, 0.7, 0.3),
        )
    return production


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


def _ground_heights(files: OrthoFiles) -> GroundHeights:
    frame_sigma_m = math.nan if files.frame_sigma_up_m is None else files.frame_sigma_up_m
    if (files.terrain is None) == (files.flat_m is None):
        raise InputError(
            "heights of the ground: either a terrain (--dem) or one flat height (--height-m) is expected"
        )
    if files.terrain is not None:
        terrain = read_terrain(files.terrain, files.height_sigma_m)
        return GroundHeights(terrain, frame_sigma_m=frame_sigma_m)
    if files.flat_m is None or files.height_sigma_m is None:
        raise InputError("one flat height: its standard deviation (--height-sigma-m) is missing")
    return GroundHeights(None, files.flat_m, files.height_sigma_m, frame_sigma_m)
