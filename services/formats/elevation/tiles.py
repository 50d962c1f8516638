"""One file of heights: its map grid, its heights in metres, and its statements."""

from dataclasses import dataclass, replace

import numpy as np
from pyproj import CRS

from amers.services.datums import DatumShift
from amers.services.errors import AmersError, FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.elevation.grid_files import HEIGHTS_OF_FORMAT, HeightsImage, open_heights
from amers.services.formats.elevation.heights import HeightDatum, HeightsByCaller, height_datum
from amers.services.formats.images.bands import one_band
from amers.services.formats.images.map_statements import map_statements
from amers.services.formats.images.raster import map_grid_of, shift_of_grid
from amers.services.formats.images.surfaces import BANDS
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.statements import Statement, Statements, Subject, Use
from amers.services.types import FloatImage

HEIGHTS_M = (-11_100.0, 9_000.0)
"""Range of heights, from the deepest sea to above the highest mountain; others are undeclared voids."""
UNDECLARED_VOID = -9999.0
"""A value so common for voids that it is never taken as a height."""


@dataclass(frozen=True)
class HeightTile:
    """A file of heights.

    Attributes:
        grid: of its nodes.
        heights: metres in the vertical datum, NaN in voids.
        datum: unit and vertical datum.
        statements: of the file.
        sigmas: one standard deviation of the heights, metres; None where the file is no surface.
    """

    grid: MapGrid
    heights: "Heights"
    datum: HeightDatum
    statements: Statements
    sigmas: "Sigmas | None" = None


@dataclass(frozen=True)
class Heights:
    """The values of a file in metres, with voids as NaN; an `ImageSource`."""

    image: HeightsImage
    unit_m: float

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.image.shape

    def read(self, window: Window) -> FloatImage:
        """Heights of a window; NaN outside the file."""
        image = self.image
        heights = image.read(window)
        void = heights == UNDECLARED_VOID
        heights *= np.float32(image.scale * self.unit_m)
        heights += np.float32(image.offset * self.unit_m)
        with np.errstate(invalid="ignore"):
            void |= (heights < HEIGHTS_M[0]) | (heights > HEIGHTS_M[1])
        heights[void] = np.nan
        return heights

    def close(self) -> None:
        """Close the file."""
        self.image.close()


@dataclass(frozen=True)
class Sigmas:
    """The standard deviations of the heights of a surface, metres; an `ImageSource`."""

    image: HeightsImage

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.image.shape

    def read(self, window: Window) -> FloatImage:
        """Standard deviations of a window; NaN outside the file and where there is no height."""
        return self.image.with_mix(one_band(2)).read(window)

    def close(self) -> None:
        """Close the file."""
        self.image.close()


def read_tile(
    path: FilePlace,
    caller: HeightsByCaller,
    *,
    images_only: bool = False,
    known: dict[tuple[str, str], tuple[DatumShift, HeightDatum]] | None = None,
) -> HeightTile:
    """Open a file of heights, of any kind of `open_heights`.

    Args:
        path: of the file.
        caller: what the caller states of its heights.
        images_only: as for `open_heights`.
        known: datums by what tiles of the same terrain state, which are not worked out again; extended.

    Raises:
        FormatError, VerticalDatumError: as for `read_dem`.
    """
    image = open_heights(path, images_only)
    try:
        grid = map_grid_of(image)
        if grid is None:
            raise FormatError(
                f"{path}: expected heights with a map grid, found no reference system; where the file "
                f"cannot state one, write {path.stem}.prj beside it (gdalsrsinfo -o wkt EPSG:CODE)"
            )
        if image.validity.colours[0] == "palette":
            raise FormatError(f"{path}: band 1 has a palette of colours; heights expected")
        if caller.by_format is None and image.dataset.driver in HEIGHTS_OF_FORMAT:
            caller = replace(caller, by_format=HEIGHTS_OF_FORMAT[image.dataset.driver])
        shift, datum = _datums(image, grid, caller, {} if known is None else known)
    except AmersError:
        image.close()
        raise
    of_datum = (replace(statement, file=path.name) for statement in datum.statements)
    statements = (
        *image.statements,
        *map_statements(image, grid, shift, has_sigmas=False),
        *of_datum,
        *_of_values(image),
    )
    sigmas = Sigmas(image) if _is_surface(image) else None
    return HeightTile(grid, Heights(image, datum.unit_m), datum, statements, sigmas)


def _is_surface(image: HeightsImage) -> bool:
    """Whether the second band states the standard deviations of the first one."""
    return image.dataset.descriptions[:2] == BANDS[:2]


def _datums(
    image: HeightsImage,
    grid: MapGrid,
    caller: HeightsByCaller,
    known: dict[tuple[str, str], tuple[DatumShift, HeightDatum]],
) -> tuple[DatumShift, HeightDatum]:
    key = (grid.crs, image.unit)
    if key not in known:
        shift = shift_of_grid(image, grid)
        middle = grid.lon_lat((np.array([grid.shape]) - 1.0) / 2.0)[0]
        crs = CRS.from_wkt(grid.crs)
        if image.crs and not crs.is_compound and CRS.from_wkt(image.crs).is_compound:
            crs = CRS.from_wkt(image.crs)
        datum = height_datum(crs, shift, middle, caller, str(image.path), band_unit=image.unit)
        known[key] = shift, datum
    return known[key]


def _of_values(image: HeightsImage) -> Statements:
    """What a file states of its values: voids, scale, other bands."""
    name, dataset = image.path.name, image.dataset
    used = Statement(name, Subject.UNIT, Use.USED, "", "band 1")
    others: list[Statement] = []
    if dataset.driver == "SRTMHGT":
        others.append(Statement(name, Subject.PLACE, Use.USED, name[:7], "name of the file"))
    if not image.validity.is_stated(1):
        note = f"voids are {UNDECLARED_VOID:g}, and heights that no ground has"
        others.append(
            Statement(
                name,
                Subject.VALIDITY,
                Use.ASSUMED,
                "no value for voids",
                note=note,
                is_usual=True,
            )
        )
    if (image.scale, image.offset) != (1.0, 0.0):
        value = f"scale {image.scale:g}, offset {image.offset:g}"
        others.append(replace(used, value=value))
    first_other = 2
    if _is_surface(image):
        first_other = 3
        others.append(Statement(name, Subject.BANDS, Use.USED, "sigma of the heights", "band 2"))
    if dataset.count >= first_other:
        value = f"bands {first_other} to {dataset.count}"
        others.append(Statement(name, Subject.BANDS, Use.NOT_USED, value, note="heights are band 1"))
    return tuple(others)
