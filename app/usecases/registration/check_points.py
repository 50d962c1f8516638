"""Read the check points of a scene: known ground marked in it, and held out of its registration."""

import re
from functools import partial
from pathlib import Path

import numpy as np

from amers.app.errors import InputError
from amers.services.errors import reword
from amers.services.formats.gcp.marked_points import MarkedPoints
from amers.services.formats.gcp.reader import read_control_points
from amers.services.imagery.marks import check_marks_inside, check_not_exchanged
from amers.services.imagery.scene import Scene
from amers.services.quality.check_points import CheckPoints
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Array

_OPTIONS = (
    (r", or the grid file of a geoid \(--geoid\)", ""),
    (r"state it \(--crs\), such as EPSG:32633, or in", "state it in"),
    (r"name (it|them|the one to use) \(--columns [^)]*\)", "rename its column"),
    (r"--vertical and --geoid|--vertical|--geoid", "--check-heights"),
)
"""Options that commands on check points do not have, and what a message says in their place."""


def read_check_points(path: Path, heights: str | None, image: Path, scene: Scene) -> CheckPoints:
    """The check points of a scene: the points that its file flags as such; all points if it flags none.

    Args:
        path: of the file, in any format that `read_control_points` reads.
        heights: vertical datum of its heights, where it states none; see `read_control_points`.
        image: of the scene; marks in other images are not used.
        scene: needs no heights if it is an ortho-image.

    Raises:
        InputError: the file cannot be used, or has no check point of this scene.
    """
    every = marks_of_scene(path, heights, image, scene)
    marks = every.take(every.check if every.check.any() else every.active)
    if len(marks) == 0:
        raise InputError(f"{path.name}: all {len(every)} points are switched off; switch some on")
    lon_lat_h = ground_positions(marks, path, scene)
    return CheckPoints(lon_lat_h, marks.line_sample, marks.sigma_m, marks.sigma_px, marks.statements)


def marks_of_scene(path: Path, heights: str | None, image: Path, scene: Scene) -> MarkedPoints:
    """The marks of a file that are in one image.

    Args:
        path: of the file, in any format that `read_control_points` reads.
        heights: vertical datum of its heights, where it states none; see `read_control_points`.
        image: of the scene; a mark that names no image is in it.
        scene: of the image.

    Raises:
        InputError: the file cannot be used, has no mark in this image, a mark lies outside it, or
            latitude and longitude are exchanged.
    """
    try:
        marks = read_control_points(path, heights)
    except InputError as error:
        for option, instead in _OPTIONS:
            reword(error, partial(re.sub, option, instead))
        raise
    return marks_in_image(marks, path, image, scene)


def marks_in_image(marks: MarkedPoints, path: Path, image: Path, scene: Scene) -> MarkedPoints:
    """The marks of a file that are in one image, or name none.

    Args:
        marks: of the file, one at least.
        path: of the file.
        image: of the scene.
        scene: of the image.

    Raises:
        InputError: there is none, a mark lies outside the image, or latitude and longitude are
            exchanged.
    """
    names = np.char.lower(marks.image)
    is_in_scene = np.isin(names, ["", image.name.lower(), image.stem.lower()])
    if not is_in_scene.any():
        others = ", ".join(sorted(set(marks.image.tolist()))[:3]) or "no image"
        raise InputError(f"{path.name}: expected marks in {image.name}, found marks in {others}")
    taken = marks.take(is_in_scene)
    names_of_image = np.full(len(taken), image.name)
    shape = np.tile(scene.image.shape, (len(taken), 1))
    check_marks_inside(taken.line_sample, taken.id, names_of_image, shape, path.name)
    check_not_exchanged(taken.lon_lat_h, [scene], path.name)
    return taken


def ground_positions(marks: MarkedPoints, path: Path, scene: Scene) -> Array:
    """Ground positions (n, 3) of the points; missing heights are 0 where an ortho-image needs none."""
    missing = np.isnan(marks.lon_lat_h[:, 2])
    if missing.any() and not isinstance(scene.model, OrthoModel):
        raise InputError(
            f"{path.name}: {int(missing.sum())} of {len(marks)} points have no height; a scene that is "
            "not an ortho-image needs heights (--control takes them from --control-dem)"
        )
    return np.nan_to_num(marks.lon_lat_h, nan=0.0)
