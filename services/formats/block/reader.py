"""An Amers block read: a folder of points, their views, their chips and the models of their images."""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np

from services.errors import FormatError
from services.formats.block.document import BlockDocument
from services.formats.block.document_json import BLOCK_JSON, parse_block_json
from services.formats.block.tables import (
    POINTS_PARQUET,
    VIEWS_PARQUET,
    Dates,
    PointRows,
    Texts,
    ViewRows,
    covariance_from_spread,
    read_points,
    read_views,
)
from services.formats.chips.npy_files import ChipFile, read_chip_file, read_chips
from services.types import ChipArray, ControlPoints, IntArray, Views


@dataclass(frozen=True)
class BlockContents:
    """A block as read, without its chips.

    Attributes:
        document: what block.json says.
        points: in file order; `chip_files` are paths in the block, `views.images` those of the document.
        n_views: (n,) int64, images that see the point.
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
    """Read a block without its chips; only what is needed to make sense of it is checked.

    Raises:
        FormatError: a file is missing or unreadable, or points and views do not belong together.
    """
    document = read_document(folder)
    points, views = read_points(folder / POINTS_PARQUET), read_views(folder / VIEWS_PARQUET)
    expected = np.repeat(points.id, np.maximum(points.chip_count, 0))
    if len(expected) != len(views.point_id) or (expected != views.point_id).any():
        raise FormatError(f"{VIEWS_PARQUET}: point_id: its rows do not follow those of {POINTS_PARQUET}")
    return assemble(document, points, views)


def read_document(folder: Path) -> BlockDocument:
    """Read the block.json of a folder.

    Raises:
        FormatError: it is missing or does not say what it should.
    """
    try:
        text = (Path(folder) / BLOCK_JSON).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{folder}: no readable {BLOCK_JSON}: {error}") from error
    return parse_block_json(text)


def assemble(document: BlockDocument, points: PointRows, views: ViewRows) -> BlockContents:
    """The contents of a block, from its parts.

    Raises:
        FormatError: a view is of an image that block.json does not list.
    """
    known = {image.image_id: row for row, image in enumerate(document.images)}
    unknown = sorted(set(views.image_ids) - set(known))
    if unknown:
        raise FormatError(
            f"{VIEWS_PARQUET}: image_id: {unknown[0]!r} is not in amers:images of {BLOCK_JSON}"
        )
    image_rows = np.array([known[name] for name in views.image_ids], dtype=np.int64)
    start = np.concatenate([[0], np.cumsum(points.chip_count)]).astype(np.int64)
    control_points = ControlPoints(
        id=points.id,
        lon_lat_h=points.lon_lat_h,
        covariance_m2=covariance_from_spread(points.sigma_m, points.correlation),
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
    )
    return BlockContents(
        document, control_points, points.n_views, points.typology, points.first_view, points.last_view
    )


def block_member(folder: Path, name: str) -> Path:
    """The path of a file of a block.

    Raises:
        FormatError: the name leaves the folder or passes through a link.
    """
    parts = name.split("/")
    if not name or name.startswith("/") or "\\" in name or {"", ".", ".."} & set(parts) or "\0" in name:
        raise FormatError(f"{name!r:.200}: not a path inside the block")
    path = Path(folder)
    for part in parts:
        path = path / part
        if path.is_symlink():
            raise FormatError(f"{name!r:.200}: passes through a link")
    return path


class FolderChips:
    """The chips of a block folder, a `ChipSource`; files stay open until `close`."""

    def __init__(self, folder: Path) -> None:
        self._folder = Path(folder)
        self._open: dict[str, tuple[int, ChipFile]] = {}

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """Consecutive chips of one file, by one `pread`.

        Returns:
            (count, 101, 101) uint8 or uint16; 0 is nodata.

        Raises:
            FormatError: there is no such file in the block, or it does not hold them.
        """
        if file not in self._open:
            path = block_member(self._folder, file)
            layout = read_chip_file(path, file)
            self._open[file] = (os.open(path, os.O_RDONLY | os.O_CLOEXEC), layout)
        descriptor, layout = self._open[file]
        return read_chips(descriptor, layout, file, row, count)

    def close(self) -> None:
        """Close the files."""
        while self._open:
            os.close(self._open.popitem()[1][0])

    def __enter__(self) -> "FolderChips":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def file_sha256(path: Path) -> str:
    """Checksum of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
