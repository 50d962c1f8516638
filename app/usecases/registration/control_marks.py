"""Read the marks that a scene is registered on: ground points that a person marked in its image."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

import numpy as np

from amers.app.errors import InputError
from amers.app.usecases.marked_files import PointStatements
from amers.app.usecases.registration.check_points import ground_positions, marks_in_image
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.datums import filled_sigmas
from amers.services.errors import refuse_unstated
from amers.services.formats.gcp.json_formats import format_opf
from amers.services.formats.gcp.marked_points import MarkedPoints, joined_marks
from amers.services.formats.gcp.reader import read_marked_ground, read_or_missing
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.quality.check_points import MARKING_SIGMA_PX, CheckPoints
from amers.services.registration.scene_marks import SceneMarks
from amers.services.statements import Statement, Statements, Subject, Use, gathered
from amers.services.types import Frame

_FRAME_OPTION = "--control-frame-sigma-m HORIZONTAL,UP, e.g. 0.05,0.05 for GNSS"


@dataclass(frozen=True)
class MarkFiles:
    """Files of marks, and what they do not state.

    Attributes:
        paths: of the files, one at least.
        points: heights, sigmas and frame, where the files state none.
        terrain: heights of marks whose file has none, as that of QGIS; None for none.
        terrain_sigma_m: one standard deviation of these heights; None for that of the terrain.
        of_many: whether they are of several scenes: marks that name no image are then in the one that
            their file is named like.
    """

    paths: tuple[Path, ...]
    points: PointStatements = field(default_factory=PointStatements)
    terrain: TerrainFile | None = None
    terrain_sigma_m: float | None = None
    of_many: bool = False

    @property
    def name(self) -> str:
        """Of the files, for people."""
        return ", ".join(path.name for path in self.paths)


@dataclass(frozen=True)
class MarksOfScene:
    """The marks of a scene.

    Attributes:
        control: those that the scene is registered on.
        check: those that their files hold out; None without any.
    """

    control: SceneMarks
    check: CheckPoints | None


def read_control_marks(
    files: MarkFiles, image: Path, scene: Scene, *, may_lack: bool = False
) -> MarksOfScene:
    """The marks of a scene. A sigma that nobody states is assumed, and stated as such.

    Args:
        files: of the marks; marks in other images are not used.
        image: of the scene.
        scene: of the image; needs no heights if it is an ortho-image.
        may_lack: whether the image may have no mark, as one of many.

    Raises:
        InputError: a file cannot be used, does not state its heights, or has no mark of this scene; all
            marks are check points; a point is marked twice.
    """
    return marks_to_adjust(_read(files), files, image, scene, may_lack=may_lack)


def _read(files: MarkFiles) -> list[tuple[Path, MarkedPoints]]:
    """The marks of every file that are switched on."""
    read, unstated = [], []
    for path in files.paths:
        marks, missing = read_or_missing(read_marked_ground, path, files.points.stated)
        unstated += missing
        if files.of_many:
            marks = replace(marks, image=np.where(marks.image == "", path.stem, marks.image))
        marks = marks.take(marks.is_marked)
        if len(marks) == 0:
            raise InputError(f"{path.name}: none of its marks is switched on; switch some on")
        read.append((path, marks))
    refuse_unstated(unstated)
    return read


def marks_as_opf(files: MarkFiles, image: Path, scene: Scene) -> str:
    """The marks of a scene as one OPF document, which states longitude, latitude and ellipsoid heights.

    Args:
        files: of the marks.
        image: of the scene; marks in other images are left out.
        scene: of the image.

    Raises:
        InputError: as `read_control_marks`, or a sigma is not stated.
    """
    parts = []
    read = _read(files)
    for path, marks in read:
        taken, points = marks_in_image(marks, path, image, scene), files.points
        if points.sigma_m is not None:
            filled = filled_sigmas(taken.sigma_m, points.sigma_m, taken.datum_sigma_m)
            taken = replace(taken, sigma_m=filled)
        if points.mark_sigma_px is not None:
            taken = replace(taken, sigma_px=np.nan_to_num(taken.sigma_px, nan=points.mark_sigma_px))
        taken = _on_terrain(taken, path, files)
        if np.isnan(taken.sigma_m).any() or np.isnan(taken.sigma_px).any():
            raise InputError(
                f"{path.name}: marks that are converted for a service need all their sigmas: state "
                "those of their ground (--control-sigma-m HORIZONTAL,UP) and of the marks "
                "(--control-mark-sigma-px)"
            )
        ids = [f"{path.name}:{name}" for name in taken.id.tolist()] if len(read) > 1 else taken.id
        ground = ground_positions(taken, path, scene)
        parts.append(replace(taken, id=np.array(ids, dtype=np.str_), lon_lat_h=ground))
    return format_opf(joined_marks(parts))


def marks_to_adjust(
    read: Sequence[tuple[Path, MarkedPoints]],
    files: MarkFiles,
    image: Path,
    scene: Scene,
    *,
    may_lack: bool = False,
) -> MarksOfScene:
    """The marks of a scene, of files that were read; see `read_control_marks`.

    Args:
        read: marks with the files that they are of.
        files: what is stated of them; its paths are not read.
        image: of the scene; marks in other images are not used.
        scene: of the image.
        may_lack: whether the image may have no mark.

    Raises:
        InputError: as `read_control_marks`.
    """
    parts = [
        _on_terrain(_completed(marks, path, files.points, image, scene), path, files)
        for path, marks in (
            (path, _of_image(marks, image) if may_lack else marks) for path, marks in read
        )
    ]
    several = len(parts) > 1
    names = [
        f"{path.name}:{name}" if several else name
        for (path, _), part in zip(read, parts, strict=True)
        for name in part.id.tolist()
    ]
    _refuse_twice(names, files)
    lon_lat_h = np.concatenate(
        [ground_positions(part, path, scene) for (path, _), part in zip(read, parts, strict=True)]
    )
    line_sample, sigma_m, sigma_px, check = (
        np.concatenate([getattr(part, column) for part in parts])
        for column in ("line_sample", "sigma_m", "sigma_px", "check")
    )
    if check.all() and not may_lack:
        raise InputError(
            f"{files.name}: all {len(check)} marks are check points, none is left to register the scene "
            "on; switch the flag of some off, or give the file as --check-points"
        )
    statements = gathered(chain(*(part.statements for part in parts)))
    control, rows = np.flatnonzero(~check), np.flatnonzero(check)
    frame_m = files.points.frame_sigma_m or (math.nan, math.nan)
    return MarksOfScene(
        SceneMarks(
            names=tuple(names[row] for row in control),
            lon_lat_h=lon_lat_h[control],
            line_sample=line_sample[control],
            sigma_m=sigma_m[control],
            sigma_px=sigma_px[control],
            frame=replace(Frame.from_sigmas(*frame_m), how_to_state=_FRAME_OPTION),
            statements=statements,
        ),
        CheckPoints(lon_lat_h[rows], line_sample[rows], sigma_m[rows], sigma_px[rows])
        if len(rows)
        else None,
    )


def read_marks_together(files: MarkFiles, scenes: Sequence[tuple[Path, Scene]]) -> list[MarksOfScene]:
    """The marks of several scenes, none in some of them; those of one name are one point.

    Args:
        files: of the marks.
        scenes: with the files of their images.

    Raises:
        InputError: as `read_control_marks`; or no scene has a mark.
    """
    every = [read_control_marks(files, image, scene, may_lack=True) for image, scene in scenes]
    names = dict.fromkeys(name for marks in every for name in marks.control.names)
    if not names:
        raise InputError(f"{files.name}: expected marks in one of {len(scenes)} images, found none")
    row = {name: -(k + 1) for k, name in enumerate(names)}

    def numbered(marks: SceneMarks) -> SceneMarks:
        return replace(marks, number=np.array([row[name] for name in marks.names], dtype=np.int64))

    return [replace(marks, control=numbered(marks.control)) for marks in every]


def _completed(
    marks: MarkedPoints, path: Path, points: PointStatements, image: Path, scene: Scene
) -> MarkedPoints:
    """The marks of a file in one image, with sigmas that the caller states, or that are assumed."""
    taken = marks if len(marks) == 0 else marks_in_image(marks, path, image, scene)
    statements: Statements = ()
    sigma_m, sigma_px = taken.sigma_m, taken.sigma_px
    if points.sigma_m is not None:
        sigma_m = filled_sigmas(sigma_m, points.sigma_m, taken.datum_sigma_m)
    elif np.isnan(sigma_m).any():
        gsd_m = scene_gsd_m(scene)
        sigma_m = filled_sigmas(sigma_m, (gsd_m, gsd_m), taken.datum_sigma_m)
        statements += (
            Statement(
                path.name,
                Subject.ACCURACY,
                Use.ASSUMED,
                f"{gsd_m:.2g} m, one pixel of the image",
                "ground of the marks",
                "state it with --control-sigma-m HORIZONTAL,UP",
            ),
        )
    if np.isnan(sigma_px).any():
        value_px = points.mark_sigma_px or MARKING_SIGMA_PX
        sigma_px = np.nan_to_num(sigma_px, nan=value_px)
        if points.mark_sigma_px is None:
            statements += (
                Statement(
                    path.name,
                    Subject.ACCURACY,
                    Use.ASSUMED,
                    f"{value_px:g} px",
                    "positions of the marks in the image",
                    "state it with --control-mark-sigma-px",
                ),
            )
    return replace(
        taken, sigma_m=sigma_m, sigma_px=sigma_px, statements=(*taken.statements, *statements)
    )


def _on_terrain(marks: MarkedPoints, path: Path, files: MarkFiles) -> MarkedPoints:
    """The marks of a file with heights of the terrain where it states none.

    What a mark is off by on the map moves its height on a slope.
    """
    missing = np.flatnonzero(np.isnan(marks.lon_lat_h[:, 2]))
    if files.terrain is None or not len(missing):
        return marks
    terrain = read_terrain(files.terrain, files.terrain_sigma_m)
    lon_lat_h, sigma_m = marks.lon_lat_h.copy(), marks.sigma_m.copy()
    place = lon_lat_h[missing, :2]
    lon_lat_h[missing, 2] = terrain.height_m(place)
    void = missing[np.isnan(lon_lat_h[missing, 2])]
    if len(void):
        raise InputError(
            f"{path.name}, point {marks.id[void[0]]}: {files.terrain.dem.name} has no height there "
            f"({len(void)} of {len(missing)} points without one); give a terrain that covers the marks"
        )
    on_slope_m2 = ((np.nan_to_num(terrain.slope(place)) * sigma_m[missing, :2]) ** 2).sum(axis=1)
    sigma_m[missing, 2] = np.sqrt(terrain.sigma_m(place) ** 2 + on_slope_m2)
    value = f"{len(missing)} heights of {files.terrain.dem.name}"
    used = Statement(path.name, Subject.VERTICAL_DATUM, Use.USED, value, "heights of the marks")
    statements = (*marks.statements, *terrain.statements, used)
    return replace(marks, lon_lat_h=lon_lat_h, sigma_m=sigma_m, statements=statements)


def _of_image(marks: MarkedPoints, image: Path) -> MarkedPoints:
    """The marks that are in an image, or name none; perhaps none of them."""
    names = np.char.lower(marks.image)
    return marks.take(np.isin(names, ["", image.name.lower(), image.stem.lower()]))


def _refuse_twice(names: Sequence[str], files: MarkFiles) -> None:
    """Refuse a point that is marked twice in the image."""
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            f"{files.name}: point {twice[0]} is marked {names.count(twice[0])} times in the image; "
            "leave one mark of each point"
        )
