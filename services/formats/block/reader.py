"""Reading an Amers block: a folder with points, views, chips and the models of the images."""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.block.document import BlockDocument
from amers.services.formats.block.document_json import BLOCK_JSON, parse_block_json
from amers.services.formats.block.tables import (
    POINTS_PARQUET,
    VIEWS_PARQUET,
    Dates,
    PointRows,
    Texts,
    ViewRows,
    covariance_from_sigmas,
    read_points,
    read_views,
)
from amers.services.formats.chips.npy_files import ChipFile, read_chip_file
from amers.services.formats.members import folder_member
from amers.services.types import ChipArray, ControlPoints, IntArray, Views


@dataclass(frozen=True)
class BlockContents:
    """The content of a block, without its chips.

    Attributes:
        document: content of `block.json`.
        points: in file order; `chip_files` are paths in the block, `views.images` those of the document.
        n_views: (n,) int64, number of images that see the point.
        typology: (n,) str or None.
        first_view, last_view: (n,) datetime64[D], NaT when unknown.
    """

    document: BlockDocument
    points: ControlPoints
    n_views: IntArray
    typology: Texts
    first_view: Dates
    last_view: Dates


def read_block(folder: Path) -> BlockContents:
    """The content of a block, without its chips and without the checks of `check_block`.

    Raises:
        FormatError: a file is missing or unreadable, or the views do not match the points.
    """
    document = read_document(folder)
    points = read_points(folder / POINTS_PARQUET, document.counts.points)
    views = read_views(folder / VIEWS_PARQUET, document.counts.views)
    expected = np.repeat(points.id, np.maximum(points.chip_count, 0))
    if len(expected) != len(views.point_id) or (expected != views.point_id).any():
        raise FormatError(
            f"{VIEWS_PARQUET}: point_id: the order of the rows differs from {POINTS_PARQUET}, "
            "the same order expected"
        )
    return block_contents(document, points, views)


def read_document(folder: Path) -> BlockDocument:
    """The `block.json` of a folder.

    Raises:
        FormatError: the file is missing, or a field is missing or wrong.
    """
    try:
        text = (Path(folder) / BLOCK_JSON).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{folder}: {BLOCK_JSON} cannot be read: {error}") from error
    return parse_block_json(text)


def block_contents(document: BlockDocument, points: PointRows, views: ViewRows) -> BlockContents:
    """The content of a block, from its document and the rows of its tables.

    Raises:
        FormatError: a view names an image that `block.json` does not list.
    """
    row_of_image = {image.image_id: row for row, image in enumerate(document.images)}
    unlisted = sorted(set(views.image_ids) - set(row_of_image))
    if unlisted:
        raise FormatError(
            f"{VIEWS_PARQUET}: image_id: {unlisted[0]!r} found, an image of amers:images in "
            f"{BLOCK_JSON} expected"
        )
    image_rows = np.array([row_of_image[name] for name in views.image_ids], dtype=np.int64)
    start = np.concatenate([[0], np.cumsum(points.chip_count)]).astype(np.int64)
    control_points = ControlPoints(
        id=points.id,
        lon_lat_h=points.lon_lat_h,
        covariance_m2=covariance_from_sigmas(points.sigma_m, points.correlation),
        block=np.zeros(len(points.id), dtype=np.int64),
        frames=(document.metadata.frame,),
        saliency=points.saliency,
        health=np.ones(len(points.id)),
        views=Views(
            start=start,
            gsd_m=views.gsd_m,
            image=image_rows[views.image],
            incidence_deg=views.incidence_deg,
            azimuth_deg=views.azimuth_deg,
            health=np.ones(len(views.gsd_m)),
            images=document.images,
        ),
        chip_file=points.chip_file,
        chip_row=points.chip_row,
        chip_files=points.chip_files,
        surface=points.surface,
    )
    return BlockContents(
        document, control_points, points.n_views, points.typology, points.first_view, points.last_view
    )


def block_member(folder: Path, name: str) -> Path:
    """The path of a file of a block.

    Raises:
        FormatError: the name leads out of the folder or through a symbolic link.
    """
    return folder_member(folder, name, "the block")


class FolderChips:
    """The chips of a block folder, as a `ChipSource`; files stay open until `close`."""

    def __init__(self, folder: Path) -> None:
        self._folder = Path(folder)
        self._open: dict[str, tuple[int, ChipFile]] = {}

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """Consecutive chips of one file, read by one `pread`.

        Returns:
            (count, 101, 101) uint8 or uint16; 0 is nodata.

        Raises:
            FormatError: the file is missing in the block, or ends before the last of these chips.
        """
        if file not in self._open:
            path = block_member(self._folder, file)
            layout = read_chip_file(path, file)
            self._open[file] = (os.open(path, os.O_RDONLY | os.O_CLOEXEC), layout)
        descriptor, layout = self._open[file]
        start, size = layout.byte_range(row, count)
        return layout.decode(os.pread(descriptor, size, start), row, count)

    def __reduce__(self) -> tuple[type["FolderChips"], tuple[Path]]:
        """In another process the files are opened again."""
        return FolderChips, (self._folder.resolve(),)

    def close(self) -> None:
        """Close all files."""
        while self._open:
            os.close(self._open.popitem()[1][0])

    def __enter__(self) -> "FolderChips":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
