"""Ground coordinates of points that are marked in two images or more, with what their marks show."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amers.app.usecases.marks_in_images import (
    OF_MODELS,
    ImageMarks,
    MarkedImages,
    read_image_marks,
)
from amers.services.adjustment.intersected_marks import (
    EXACT_MODEL,
    IntersectedMarks,
    intersect_marks,
)
from amers.services.errors import NotEnoughPoints
from amers.services.formats.vector.point_layer import check_point_suffix, write_point_layer
from amers.services.imagery.scene import scene_gsd_m
from amers.services.quality.accuracy_statement import StatedAccuracy, points_accuracy
from amers.services.quality.known_ground import ground_errors, residual_parallaxes_m
from amers.services.statements import Statements
from amers.services.types import UNKNOWN_FRAME, Array

_LAYER = "intersected_points"
_SCALE_NOTED = 1.5
"""Ratio of residuals to what is stated, or its inverse, that is worth a note."""
_SCALE_CHANCE = 0.01
"""A scale that chance explains with a larger probability is not."""


@dataclass(frozen=True)
class IntersectedPoint:
    """A point marked in two images or more.

    Attributes:
        id: its name.
        lon, lat, height_m: degrees, and metres above the WGS 84 ellipsoid.
        sigma_m: east, north, up, one sigma, relative to what the result names; null when unknown.
        covariance_m2: of east, north, up, the same.
        on_the_earth_sigma_m, on_the_earth_covariance_m2: with the errors that all points share.
        images: that its position is from.
        base_to_height: largest base over height of two of them.
        largest_residual_px: of its marks, used or not.
        largest_residual_image: in which image it is.
        is_check: whether the file flags it as a check point.
        error_m: east, north, up, intersected minus known; null where nothing is known.
    """

    id: str
    lon: float
    lat: float
    height_m: float
    sigma_m: list[float]
    covariance_m2: list[list[float]]
    on_the_earth_sigma_m: list[float]
    on_the_earth_covariance_m2: list[list[float]]
    images: int
    base_to_height: float
    largest_residual_px: float
    largest_residual_image: str
    is_check: bool
    error_m: list[float] | None


@dataclass(frozen=True)
class WrongMark:
    """A mark that disagrees with the others of its point, and was not used.

    Attributes:
        id: of the point.
        image: of the mark.
        off_px: line and sample, marked minus computed from the other images.
        or_image: image whose mark may be wrong in its place; null where the marks leave no doubt.
    """

    id: str
    image: str
    off_px: list[float]
    or_image: str | None


@dataclass(frozen=True)
class MarkedImage:
    """One of the images.

    Attributes:
        image: its name.
        marks: number of its marks that are used.
        shift_px: line, sample, of the marks from the model, within the error of the model.
    """

    image: str
    marks: int
    shift_px: list[float]


@dataclass(frozen=True)
class KnownGround:
    """Points compared with known ground.

    Attributes:
        points: that are compared: check points, or without any all points of known ground.
        rms_m, mean_m: of the errors, east, north, up; null when unknown.
        normalised: mean square of the errors over their stated covariance: 1 where that is honest.
    """

    points: int
    rms_m: list[float]
    mean_m: list[float]
    normalised: float


@dataclass(frozen=True)
class PointIntersection:
    """Points intersected from marks.

    Attributes:
        points: with a position.
        relative, on_the_earth: accuracy of the median point.
        known_ground: the comparison; null where nothing is known.
        residual_parallax_m: along lines and samples, rms of the differences between two images.
        scale: residuals over what is stated of marks and models; null without redundancy.
        wrong_marks: found with three images or more.
        disagreeing: points whose two marks disagree.
        left_out: why points have no position, by their names.
        images: that the points are marked in.
        notes: what a reader has to know, in words.
        statements: of all files.
    """

    points: list[IntersectedPoint]
    relative: StatedAccuracy
    on_the_earth: StatedAccuracy
    known_ground: KnownGround | None
    residual_parallax_m: list[float]
    scale: float
    wrong_marks: list[WrongMark]
    disagreeing: list[str]
    left_out: dict[str, str]
    images: list[MarkedImage]
    notes: list[str]
    statements: Statements


def intersect_files(files: MarkedImages, output: Path | None = None) -> PointIntersection:
    """The points of some files of marks.

    Args:
        files: marks and images.
        output: file to write them to: CSV, GeoJSON or GeoPackage, by its suffix.

    Raises:
        InputError: a file cannot be used.
        NotEnoughPoints: no point is marked in two images.
    """
    if output is not None:
        check_point_suffix(output)
    read = read_image_marks(files)
    result = _Result.of(read)
    intersection = result.described()
    if output is not None:
        _write(output, intersection)
    return intersection


@dataclass(frozen=True)
class _Result:
    """Points with their covariances (n, 3, 3): relative, and on the Earth."""

    read: ImageMarks
    found: IntersectedMarks
    relative_m2: Array
    on_the_earth_m2: Array

    @classmethod
    def of(cls, read: ImageMarks) -> "_Result":
        is_stated = all(np.isfinite(one.shift_px2).all() for one in read.errors)
        errors = [one if np.isfinite(one.shift_px2).all() else EXACT_MODEL for one in read.errors]
        models = [scene.model for scene in read.scenes]
        found = intersect_marks(models, errors, read.marks, len(read.names))
        if not found.found.any():
            raise NotEnoughPoints(
                0, 1, f"none of {len(read.names)} points is marked in two images whose rays meet"
            )
        joint_m2 = found.joint_m2 if is_stated else np.full_like(found.joint_m2, np.nan)
        relative_m2 = (joint_m2 if read.is_registered else found.marks_m2) + read.shared_m2
        earth_m2 = joint_m2 + read.shared_m2 + read.frame.covariance_m2
        return cls(read, found, relative_m2, earth_m2)

    def described(self) -> PointIntersection:
        """The result for people and programs."""
        read, found = self.read, self.found
        known = np.isfinite(read.known[:, 0]) & found.found
        compared = known & read.check if (known & read.check).any() else known
        covariance_m2 = self.on_the_earth_m2
        if not np.isfinite(covariance_m2[found.found]).all():
            covariance_m2 = self.relative_m2
        errors = ground_errors(found.lon_lat_h, covariance_m2, read.known, read.sigma_m, compared)
        ground = None
        if compared.any():
            figures = errors.rms_m.tolist(), errors.mean_m.tolist(), errors.normalised
            ground = KnownGround(int(compared.sum()), *figures)
        gsd_m = np.array([scene_gsd_m(scene) for scene in read.scenes])[read.marks.image]
        parallax_m = residual_parallaxes_m(
            found.residual_px * gsd_m[:, None], read.marks.point, found.used
        )
        relative, on_the_earth = self._accuracy()
        return PointIntersection(
            points=[self._point(p, errors.error_m[p]) for p in np.flatnonzero(found.found).tolist()],
            relative=relative,
            on_the_earth=on_the_earth,
            known_ground=ground,
            residual_parallax_m=parallax_m.tolist(),
            scale=found.scale,
            wrong_marks=[self._wrong(row) for row in np.flatnonzero(found.rejected).tolist()],
            disagreeing=[read.names[p] for p in np.flatnonzero(found.disagree).tolist()],
            left_out=self._left_out(),
            images=[
                MarkedImage(name, int((found.used & (read.marks.image == k)).sum()), shift)
                for k, (name, shift) in enumerate(
                    zip(read.image_names, found.shift_px.tolist(), strict=True)
                )
            ],
            notes=self._notes(),
            statements=read.statements,
        )

    def _point(self, p: int, error_m: Array) -> IntersectedPoint:
        read, found = self.read, self.found
        rows = np.flatnonzero(read.marks.point == p)
        length_px = np.hypot(*found.residual_px[rows].T)
        worst = int(np.argmax(length_px))
        lon, lat, height_m = found.lon_lat_h[p].tolist()
        return IntersectedPoint(
            id=read.names[p],
            lon=lon,
            lat=lat,
            height_m=height_m,
            sigma_m=_sigmas(self.relative_m2[p]),
            covariance_m2=self.relative_m2[p].tolist(),
            on_the_earth_sigma_m=_sigmas(self.on_the_earth_m2[p]),
            on_the_earth_covariance_m2=self.on_the_earth_m2[p].tolist(),
            images=int(found.used[rows].sum()),
            base_to_height=float(found.base_to_height[p]),
            largest_residual_px=float(length_px[worst]),
            largest_residual_image=read.image_names[read.marks.image[rows[worst]]],
            is_check=bool(read.check[p]),
            error_m=error_m.tolist() if np.isfinite(error_m[0]) else None,
        )

    def _wrong(self, row: int) -> WrongMark:
        marks, alternative, names = (
            self.read.marks,
            int(self.found.alternative[row]),
            self.read.image_names,
        )
        return WrongMark(
            id=self.read.names[marks.point[row]],
            image=names[marks.image[row]],
            off_px=self.found.residual_px[row].tolist(),
            or_image=None if alternative < 0 else names[marks.image[alternative]],
        )

    def _left_out(self) -> dict[str, str]:
        marks, names = self.read.marks, self.read.image_names
        reasons = {}
        for p in np.flatnonzero(~self.found.found).tolist():
            rows = np.flatnonzero(marks.point == p)
            shown_by = [names[k] for k in marks.image[rows].tolist()]
            if len(rows) == 0:
                reasons[self.read.names[p]] = "marked in no image"
            elif len(rows) == 1:
                reasons[self.read.names[p]] = f"marked in one image alone, {shown_by[0]}"
            else:
                reasons[self.read.names[p]] = f"its rays in {', '.join(shown_by)} do not meet"
        return reasons

    def _accuracy(self) -> tuple[StatedAccuracy, StatedAccuracy]:
        """The accuracy of the median point: of single points, and on the Earth."""
        of, found = "median of the points", self.found.found
        relative_m2, earth_m2 = (
            np.diag(np.median(np.diagonal(one[found], 0, 1, 2), axis=0))
            for one in (self.relative_m2, self.on_the_earth_m2)
        )
        relative = points_accuracy(relative_m2, UNKNOWN_FRAME, of).relative_to_control_points
        earth = points_accuracy(earth_m2, UNKNOWN_FRAME, of).relative_to_control_points
        whole = points_accuracy(relative_m2, self.read.frame, of).on_the_earth
        label = f"Relative to {self.read.reference}"
        words = earth.words if np.isfinite(earth_m2).all() else whole.words
        return (
            StatedAccuracy(label, relative.ce90_m, relative.le90_m, relative.words),
            StatedAccuracy(whole.label, earth.ce90_m, earth.le90_m, words),
        )

    def _notes(self) -> list[str]:
        """What nobody sees in the figures."""
        read, found = self.read, self.found
        rays = np.bincount(read.marks.point, minlength=len(read.names))
        pairs, notes = int((found.found & (rays == 2)).sum()), []
        if pairs:
            notes.append(
                f"{pairs} of {int(found.found.sum())} points are marked in two images: a wrong mark of "
                "theirs shows only across the base, and not in which image it is; mark them in a third "
                "image to find it"
            )
        is_far = found.scale > _SCALE_NOTED or found.scale < 1.0 / _SCALE_NOTED
        if is_far and found.scale_chance < _SCALE_CHANCE:
            typical_px = found.scale * float(np.median(read.marks.sigma_px))
            notes.append(
                f"residuals are {found.scale:.2f} times what is stated of marks and models, which the "
                f"sigmas of the points follow: give --mark-sigma-px {typical_px:.2g} if the marks are "
                "the reason"
            )
        for wrong in (self._wrong(row) for row in np.flatnonzero(found.rejected).tolist()):
            alternative = "" if wrong.or_image is None else f", or the one in {wrong.or_image} is wrong"
            notes.append(
                f"point {wrong.id}: its mark in {wrong.image} is {math.hypot(*wrong.off_px):.1f} px "
                f"from where the others put it{alternative}; it is not used, correct it"
            )
        notes += [
            f"point {read.names[p]}: its two marks disagree; a third image would show which is wrong"
            for p in np.flatnonzero(found.disagree).tolist()
        ]
        if read.reference == OF_MODELS:
            notes.append(
                "the images are not registered: on the Earth, points share the errors of their models; "
                "register the images (amers scene register-many) and give --registered FOLDER"
            )
        return notes + [f"point {name}: left out, {why}" for name, why in self._left_out().items()]


def _sigmas(covariance_m2: Array) -> list[float]:
    return np.sqrt(np.diagonal(covariance_m2)).tolist()  # type: ignore[no-any-return]


def _write(path: Path, result: PointIntersection) -> None:
    """Write the points with their attributes; `sigma_…_m` are relative, as readers of control expect."""
    points = result.points
    wrong = {one.id: one.image for one in result.wrong_marks}
    unknown = [math.nan] * 3
    fields = {
        "id": np.array([one.id for one in points]),
        **_axes("sigma_{}_m", [one.sigma_m for one in points]),
        **_axes("earth_sigma_{}_m", [one.on_the_earth_sigma_m for one in points]),
        "images": np.array([one.images for one in points]),
        "base_over_height": np.array([one.base_to_height for one in points]),
        "largest_residual_px": np.array([one.largest_residual_px for one in points]),
        "largest_residual_image": np.array([one.largest_residual_image for one in points]),
        "check": np.array([int(one.is_check) for one in points]),
        "wrong_mark": np.array([wrong.get(one.id, "") for one in points]),
        **_axes("error_{}_m", [one.error_m or unknown for one in points]),
    }
    positions = np.array([(one.lon, one.lat, one.height_m) for one in points])
    write_point_layer(path, _LAYER, positions, fields)


def _axes(name: str, values: list[list[float]]) -> dict[str, Array]:
    return {
        name.format(axis): column
        for axis, column in zip(("east", "north", "up"), np.array(values).T, strict=True)
    }
