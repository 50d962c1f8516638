"""Ground of a new block: excluded areas, and the land cover at the points."""

from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from amers.services.formats.ground_masks import LandCover, any_of, read_ground_mask, read_land_cover
from amers.services.quality.density import GroundMask
from amers.services.statements import Statements
from amers.services.types import Array, BoolArray, ControlPoints

UNSTEADY = ("water", "snow and ice")
"""Land cover that looks different every day: it gets no points."""


@dataclass(frozen=True)
class GroundFiles:
    """Files about the ground of a block. Classes of ESA WorldCover have names, other classes have
    numbers.

    Attributes:
        exclude: ground where no points are made: GeoJSON polygons, or an image on a map that is not 0
            there; repeat for several.
        land_cover: image of land cover classes, which become the typology of the points; no points are
            made on water, snow and ice.
    """

    exclude: tuple[Path, ...] = ()
    land_cover: Path | None = None

    def inputs(self) -> list[dict[str, Any]]:
        """What the results of a production depend on."""
        files = [*self.exclude, *([] if self.land_cover is None else [self.land_cover])]
        return [
            {
                "file": str(file.resolve()),
                "bytes": file.stat().st_size,
                "modified": file.stat().st_mtime_ns,
            }
            for file in files
        ]


@dataclass(frozen=True)
class GroundClasses:
    """The ground of a block.

    Attributes:
        excluded: where no points are wanted; None where they are wanted everywhere.
        land_cover: at positions; None when it is not known.
        statements: of the files.
    """

    excluded: GroundMask | None
    land_cover: LandCover | None
    statements: Statements = ()

    def typology(self, points: ControlPoints) -> list[str | None] | None:
        """What each point stands on; None when nothing is known."""
        if self.land_cover is None:
            return None
        names = self.land_cover(points.lon_lat_h[:, :2])
        return [None if name == "unknown" else name for name in names]


def read_ground(files: GroundFiles) -> GroundClasses:
    """The ground that files describe; their images stay open.

    Raises:
        InputError: a file cannot be read.
    """
    excluded = [read_ground_mask(path) for path in files.exclude]
    masks: list[GroundMask] = [*excluded]
    statements = tuple(chain(*(mask.statements for mask in excluded)))
    cover = None if files.land_cover is None else read_land_cover(files.land_cover)
    if cover is not None:

        def unsteady(lon_lat: Array, cover: LandCover = cover) -> BoolArray:
            return np.isin(cover(lon_lat), UNSTEADY)

        masks.append(unsteady)
        statements += cover.statements
    return GroundClasses(any_of(masks), cover, statements)
