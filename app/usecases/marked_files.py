"""Files of ground points marked in images, as control of a block."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np

from amers.app.errors import InputError
from amers.services.datums import filled_sigmas
from amers.services.errors import refuse_unstated
from amers.services.formats.addresses import FilePlace
from amers.services.formats.gcp.marked_points import MarkedPoints
from amers.services.formats.gcp.reader import (
    StatedByCaller,
    read_marked_ground,
    read_or_missing,
)
from amers.services.imagery.marks import check_marks_inside, check_not_exchanged
from amers.services.imagery.scene import Scene
from amers.services.production.marked_control import MarkedGround
from amers.services.quality.check_points import MARKING_SIGMA_PX
from amers.services.statements import gathered
from amers.services.types import Array, Frame, IntArray, Observations


@dataclass(frozen=True)
class PointStatements:
    """What files of ground points do not state, of all of them.

    Attributes:
        stated: heights, reference system, columns.
        sigma_m: horizontal and up, one standard deviation, of points whose file states none.
        frame_sigma_m: horizontal and up, of the error on the Earth that all the points share.
        mark_sigma_px: of marks whose file states none, a coordinate.
    """

    stated: StatedByCaller = field(default_factory=StatedByCaller)
    sigma_m: tuple[float, float] | None = None
    frame_sigma_m: tuple[float, float] | None = None
    mark_sigma_px: float | None = None


def read_marked(
    paths: Sequence[Path], points: PointStatements, scenes: Sequence[Scene], images: Sequence[FilePlace]
) -> MarkedGround:
    """The control points of files with their marks; those of one place are one point.

    Args:
        paths: of the files, one at least.
        points: what they do not state.
        scenes: of the block.
        images: files of the scenes, by whose names marks refer to them.

    Raises:
        InputError: a file cannot be used, does not state what it must, or a point has no mark in the
            images.
    """
    names, files = [], []
    image: list[IntArray] = []
    unstated: list[InputError] = []
    for path in paths:
        read, missing = read_or_missing(read_marked_ground, path, points.stated)
        marks = _control_marks(read, path)
        unstated += missing
        if not missing:
            image.append(images_of_marks(marks, path, scenes, images))
        names += [f"{path.name}:{name}" for name in marks.id]
        if points.sigma_m is not None:
            sigma_m = filled_sigmas(marks.sigma_m, points.sigma_m, marks.datum_sigma_m)
            marks = replace(marks, sigma_m=sigma_m)
        files.append(marks)
    lon_lat_h, sigma_m, line_sample, sigma_px = (
        np.concatenate([getattr(marks, column) for marks in files])
        for column in ("lon_lat_h", "sigma_m", "line_sample", "sigma_px")
    )
    sigma_m[np.isnan(lon_lat_h[:, 2]), 2] = np.inf
    frame_sigma_m = points.frame_sigma_m
    no_frame = [] if frame_sigma_m is not None else [_no_frame_sigma(paths[0])]
    refuse_unstated([*_unknown_sigmas(sigma_m, names), *no_frame, *unstated])
    assert frame_sigma_m is not None
    mark_sigma_px = points.mark_sigma_px or MARKING_SIGMA_PX
    place = np.round(np.nan_to_num(lon_lat_h, nan=-1e6) / _SAME_PLACE).astype(np.int64)
    _, first, point = np.unique(place, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(point, kind="stable")
    observations = Observations(
        point[order].astype(np.int64),
        np.concatenate(image)[order],
        line_sample[order],
        np.nan_to_num(sigma_px[order], nan=mark_sigma_px),
    )
    _refuse_lone_rays(observations, lon_lat_h[first], [names[row] for row in first])
    return MarkedGround(
        names=tuple(names[row] for row in first),
        lon_lat_h=lon_lat_h[first],
        sigma_m=sigma_m[first],
        frame=Frame.from_sigmas(*frame_sigma_m),
        marks=observations,
        statements=gathered(chain(*(marks.statements for marks in files))),
    )


_SAME_PLACE = np.array([1e-8, 1e-8, 1e-3])
"""Positions of one point in several files agree to this: degrees, degrees, metres."""


def _control_marks(points: MarkedPoints, path: Path) -> MarkedPoints:
    """The marks of control points; check points stay apart, and points without a mark are refused."""
    control = points.take(~points.check)
    if len(control) == 0:
        raise InputError(f"{path.name}: all {len(points)} points are check points, no control is left")
    unmarked = sorted(set(control.id.tolist()) - set(control.id[control.is_marked].tolist()))
    if unmarked:
        raise InputError(
            f"{path.name}: {len(unmarked)} points have no position in any image: {_some(unmarked)}. "
            "They cannot be found in the images: mark them, switch them off, or make a block of them "
            "with chips (amers production points) and give that as --control"
        )
    return control.take(control.is_marked)


def images_of_marks(
    marks: MarkedPoints, path: Path, scenes: Sequence[Scene], images: Sequence[FilePlace]
) -> IntArray:
    """The image (m,) of every mark, by its name, or that of the file where it names none.

    Raises:
        InputError: an image is not among those of the block, a mark lies outside its image, or latitude
            and longitude are exchanged.
    """
    of_name: dict[str, set[int]] = {}
    for row, (scene, image) in enumerate(zip(scenes, images, strict=True)):
        for name in (scene.acquisition.image_id, image.name, image.stem):
            of_name.setdefault(name.lower(), set()).add(row)
    of_file = path.name.lower() if path.name.lower() in of_name else path.stem.lower()
    names = np.where(marks.image == "", of_file, np.char.lower(marks.image))
    unknown = sorted({name for name in names.tolist() if len(of_name.get(name, ())) != 1})
    if unknown and (marks.image == "").any() and of_file in unknown:
        raise InputError(
            f"{path.name}: the marks name no image, and none of the images has the name of the file: "
            f"call it like its image, such as {images[0].stem}{path.suffix}"
        )
    if unknown:
        known = sorted(scene.acquisition.image_id for scene in scenes)
        raise InputError(
            f"{path.name}: marks in {_some(unknown)}, expected names of the images given: "
            f"{_some(known)}; give these images, or leave their marks out"
        )
    number = np.array([min(of_name[name]) for name in names.tolist()], dtype=np.int64)
    shape = np.array([scene.image.shape for scene in scenes], dtype=np.int64)[number]
    check_marks_inside(marks.line_sample, marks.id, names, shape, path.name)
    check_not_exchanged(marks.lon_lat_h, [scenes[row] for row in np.unique(number)], path.name)
    return number


def _no_frame_sigma(path: Path) -> InputError:
    return InputError(
        f"{path.name}: the common error of these points on the Earth is not stated: give it "
        "with --control-frame-sigma-m HORIZONTAL,UP, e.g. 0.05,0.05 for GNSS"
    )


def _unknown_sigmas(sigma_m: Array, names: Sequence[str]) -> list[InputError]:
    """The error of marks without sigmas of their ground; nothing where all have them."""
    unknown = np.isnan(sigma_m)
    if not unknown.any():
        return []
    row = int(np.flatnonzero(unknown.any(axis=1))[0])
    axes = [
        axis
        for axis, is_unknown in zip(("east", "north", "up"), unknown[row], strict=True)
        if is_unknown
    ]
    return [
        InputError(
            f"{int(unknown.any(axis=1).sum())} marks, such as that of {names[row]}, have no sigma "
            f"{', '.join(axes)} of their ground: state it (--control-sigma-m HORIZONTAL,UP); for an ASP "
            "file, state the axes of its sigmas (--control-sigma-axes) where you know them"
        )
    ]


def _refuse_lone_rays(marks: Observations, lon_lat_h: Array, names: Sequence[str]) -> None:
    """Refuse points of one mark without a height: they tie nothing."""
    count = np.bincount(marks.point, minlength=len(names))
    lone = np.flatnonzero((count == 1) & np.isnan(lon_lat_h[:, 2])).tolist()
    if lone:
        raise InputError(
            f"{len(lone)} control points have no height and are marked in one image alone: "
            f"{_some([names[row] for row in lone])}. State their heights, or mark them in another image"
        )


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
