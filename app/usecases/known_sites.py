"""How far each of several known sites carries alone, from marks in files."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.app.errors import InputError
from amers.app.usecases.control_experiment import adjustable, with_stated_sigmas
from amers.app.usecases.marks_in_images import (
    ImageMarks,
    MarkedImages,
    read_image_marks,
)
from amers.app.usecases.model_choice import metres_by_image
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.adjustment.control_ground import NO_CONTROL, ControlGround
from amers.services.errors import CoverageError
from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.lines_of_sight import intersect_terrain
from amers.services.quality.site_reach import KnownSite, SiteReach, site_reach
from amers.services.sensors.ortho import OrthoModel
from amers.services.statements import Statements, gathered
from amers.services.terrain import Terrain
from amers.services.types import Array, Frame, IntArray


@dataclass(frozen=True)
class SiteSigmas:
    """The accuracy of the ground of sites.

    Attributes:
        frame_m: horizontal and up, of the error that all points of one site share.
        point_m: horizontal and up, of points whose file states none.
    """

    frame_m: tuple[float, float]
    point_m: tuple[float, float] | None = None


@dataclass(frozen=True)
class SiteHeights:
    """Heights of the points that tie images, which ortho-images do not show.

    Attributes:
        terrain: the ground.
        sigma_m: one standard deviation of single heights; by default that of the terrain.
        frame_sigma_m: of the error that all of them share.
    """

    terrain: TerrainFile
    sigma_m: float | None = None
    frame_sigma_m: float = 0.0


@dataclass(frozen=True)
class SitesReached:
    """The table, and what it was made of.

    Attributes:
        reach: errors at every site by the site that is known, and moves of the corners of images.
        sites: their names.
        ties: points of unknown ground.
        heights: of them with a height of the terrain.
        statements: of all files.
    """

    reach: SiteReach
    sites: list[str]
    ties: int
    heights: int
    statements: Statements


def reach_of_sites(
    files: MarkedImages,
    sigmas: SiteSigmas,
    heights: SiteHeights | None = None,
    edge_sigma_m: Sequence[str] = (),
) -> SitesReached:
    """The errors at all sites of blocks that know one of them.

    Each file of marks with known ground is a site, by the name of the file; points without known ground
    tie the images.

    Args:
        files: marks and images as delivered.
        sigmas: of the ground of the sites.
        heights: of the ties; None where no ortho-image needs them.
        edge_sigma_m: a priori sigma of drifts and skews at the edge of images, as
            `MarkedImages.sigma_m`.

    Raises:
        InputError: a file cannot be used, or there are fewer than two sites.
        ComputationError: a block cannot be adjusted.
    """
    read = read_image_marks(files)
    known = np.asarray(np.isfinite(read.known).all(axis=1))
    sigma_m = with_stated_sigmas(read, known, sigmas.point_m)
    numbers = np.unique(read.file[known]).tolist()
    names = [files.marks[number].stem for number in numbers]
    if len(set(names)) < len(names):
        raise InputError(f"{', '.join(names)}: different names of files expected, one for each site")
    sites = [
        KnownSite(name, _ground(read, np.flatnonzero(known & (read.file == number)), sigma_m, sigmas))
        for name, number in zip(names, numbers, strict=True)
    ]
    others, statements = NO_CONTROL, read.statements
    if heights is not None:
        terrain = read_terrain(heights.terrain, heights.sigma_m)
        others = _heights(read, np.flatnonzero(~known), terrain, heights.frame_sigma_m)
        statements = gathered((*statements, *terrain.statements))
    edges_m = metres_by_image("--edge-sigma-m", edge_sigma_m, files.images)
    images = [
        adjustable(scene, edges_m.get(image))
        for scene, image in zip(read.scenes, files.images, strict=True)
    ]
    reach = site_reach(images, read.marks, sites, others)
    return SitesReached(reach, names, int((~known).sum()), len(others), statements)


def _ground(read: ImageMarks, rows: IntArray, sigma_m: Array, sigmas: SiteSigmas) -> ControlGround:
    """The known ground of a site, with a frame of its own."""
    return ControlGround(
        point=rows,
        lon_lat_h=read.known[rows],
        covariance_m2=np.eye(3) * sigma_m[rows, None] ** 2,
        source=np.zeros(len(rows), dtype=np.int64),
        frames=(Frame.from_sigmas(*sigmas.frame_m),),
        names=tuple(read.names[row] for row in rows),
        by_hand=np.ones(len(rows), dtype=np.bool_),
    )


def _heights(read: ImageMarks, ties: IntArray, terrain: Terrain, frame_sigma_m: float) -> ControlGround:
    """Heights of the terrain at the ties, where their first mark lies by the delivered model.

    The ground around counts, as far as that model may be off: its variance is in that of the height.
    """
    marks = read.marks
    ties = np.intersect1d(ties, marks.point)
    first = np.searchsorted(marks.point, ties)
    place = np.full((len(ties), 3), np.nan)
    off_m = np.zeros(len(ties))
    for number, scene in enumerate(read.scenes):
        own = marks.image[first] == number
        if own.any():
            place[own] = _places(scene, marks.line_sample[first[own]], terrain)
            off_m[own] = scene.sigma_m
    around = [
        terrain.height_m(move_metres(place, off_m[:, None] * np.array([[east, north, 0.0]]))[:, :2])
        for east, north in ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
    ]
    place[:, 2] = around[0]
    up_m2 = terrain.sigma_m(place[:, :2]) ** 2 + np.var(around, axis=0)
    kept = np.isfinite(up_m2) & np.isfinite(place).all(axis=1)
    covariance_m2 = np.tile(np.diag([np.inf, np.inf, 0.0]), (int(kept.sum()), 1, 1))
    covariance_m2[:, 2, 2] = up_m2[kept]
    return ControlGround(
        point=ties[kept],
        lon_lat_h=place[kept],
        covariance_m2=covariance_m2,
        source=np.zeros(len(covariance_m2), dtype=np.int64),
        frames=(Frame.from_sigmas(np.nan, frame_sigma_m),),
        names=tuple(f"height of {read.names[point]}" for point in ties[kept]),
    )


def _places(scene: Scene, line_sample: Array, terrain: Terrain) -> Array:
    """The ground (n, 3) that a scene shows; NaN beyond the terrain."""
    if isinstance(scene.model, OrthoModel):
        return scene.model.locate(line_sample, np.zeros(len(line_sample)))
    try:
        return intersect_terrain(scene.model, line_sample, terrain)
    except CoverageError:
        return np.full((len(line_sample), 3), np.nan)
