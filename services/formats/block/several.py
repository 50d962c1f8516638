"""Several block folders as one set of control points."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.formats.block.reader import FolderChips
from services.types import ChipArray, ControlPoints, IntArray, Views, all_surfaces


@dataclass(frozen=True)
class SeveralChips:
    """The chips of several block folders, as a `ChipSource`; see `points_of_several`.

    Attributes:
        sources: of the folders, in the order of their points.
    """

    sources: tuple[FolderChips, ...]

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """Consecutive chips of one file.

        Returns:
            (count, 101, 101) uint8 or uint16; 0 is nodata.

        Raises:
            FormatError: the file is missing in its block, or ends before the last of these chips.
        """
        number, _, name = file.partition("/")
        return self.sources[int(number)].read(name, row, count)


def points_of_several(parts: Sequence[ControlPoints]) -> ControlPoints:
    """The points of several blocks, one after the other.

    Points of the first block keep their ids; those of the others follow the largest of the blocks
    before them, because blocks number their points alike. Chip files begin with the number of their
    block.
    """
    first_ids = np.cumsum([0, *(int(one.id.max(initial=-1)) + 1 for one in parts[:-1])])
    return ControlPoints(
        id=np.concatenate([one.id + first for one, first in zip(parts, first_ids, strict=True)]),
        lon_lat_h=np.concatenate([one.lon_lat_h for one in parts]),
        covariance_m2=np.concatenate([one.covariance_m2 for one in parts]),
        block=_rows([one.block for one in parts], [len(one.frames) for one in parts]),
        frames=tuple(frame for one in parts for frame in one.frames),
        saliency=np.concatenate([one.saliency for one in parts]),
        health=np.concatenate([one.health for one in parts]),
        views=_views([one.views for one in parts]),
        chip_file=_rows([one.chip_file for one in parts], [len(one.chip_files) for one in parts]),
        chip_row=np.concatenate([one.chip_row for one in parts]),
        chip_files=tuple(
            f"{number}/{name}" for number, one in enumerate(parts) for name in one.chip_files
        ),
        surface=all_surfaces(parts),
    )


def _rows(parts: Sequence[IntArray], sizes: Sequence[int]) -> IntArray:
    """Rows of several tables as rows of these tables one after the other."""
    starts = np.cumsum([0, *sizes[:-1]])
    return np.concatenate([rows + start for rows, start in zip(parts, starts, strict=True)])


def _views(parts: Sequence[Views]) -> Views:
    starts = np.cumsum([0, *(int(one.start[-1]) for one in parts[:-1])])
    return Views(
        start=np.concatenate(
            [[0], *(one.start[1:] + start for one, start in zip(parts, starts, strict=True))]
        ).astype(np.int64),
        gsd_m=np.concatenate([one.gsd_m for one in parts]),
        image=_rows([one.image for one in parts], [len(one.images) for one in parts]),
        incidence_deg=np.concatenate([one.incidence_deg for one in parts]),
        azimuth_deg=np.concatenate([one.azimuth_deg for one in parts]),
        health=np.concatenate([one.health for one in parts]),
        images=tuple(image for one in parts for image in one.images),
    )
