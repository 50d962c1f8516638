"""Check points that a user gives: known ground, marked in a scene, held out of its registration."""

from pathlib import Path

import numpy as np

from app.errors import InputError
from services.formats.gcp.marked_points import MarkedPoints
from services.formats.gcp.reader import read_control_points
from services.imagery.scene import Scene
from services.quality.check_points import CheckPoints
from services.sensors.ortho import OrthoModel


def read_check_points(path: Path, heights: str | None, image: Path, scene: Scene) -> CheckPoints:
    """The check points of a scene: where its file says which points are held out, those; else all.

    Args:
        path: of any format that `read_control_points` reads.
        heights: what its heights are above, where it does not say; see `read_control_points`.
        image: of the scene; marks in images of other names are left aside.
        scene: an ortho-image needs no heights.

    Raises:
        InputError: the file cannot be used, or has no check point of this scene.
    """
    marks = read_control_points(path, heights)
    names = np.char.lower(marks.image)
    own = np.isin(names, ["", image.name.lower(), image.stem.lower()])
    if not own.any():
        others = ", ".join(sorted(set(marks.image.tolist()))[:3]) or "no image"
        raise InputError(f"{path.name}: expected marks in {image.name}, found marks in {others}")
    marks = marks.take(own)
    marks = marks.take(marks.check if marks.check.any() else marks.active)
    if len(marks) == 0:
        raise InputError(f"{path.name}: all {int(own.sum())} points are switched off")
    return CheckPoints(_ground(marks, path, scene), marks.line_sample, marks.sigma_m, marks.sigma_px)


def _ground(marks: MarkedPoints, path: Path, scene: Scene) -> np.ndarray:
    """The points; without heights where an ortho-image needs none."""
    missing = np.isnan(marks.lon_lat_h[:, 2])
    if missing.any() and not isinstance(scene.model, OrthoModel):
        raise InputError(
            f"{path.name}: {int(missing.sum())} of {len(marks)} points have no height, which a scene "
            "that is not an ortho-image needs"
        )
    return np.nan_to_num(marks.lon_lat_h, nan=0.0)
