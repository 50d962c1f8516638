"""Everything an Amers block promises, checked before anything of it is used."""

from collections.abc import Mapping, Set
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from services.errors import FormatError
from services.formats.block import BlockContents, assemble, block_member, file_sha256, read_document
from services.formats.block_json import BLOCK_JSON, BlockDocument
from services.formats.block_tables import (
    POINTS_PARQUET,
    VIEWS_PARQUET,
    PointRows,
    ViewRows,
    read_points,
    read_views,
)
from services.formats.chip_files import ChipFile, read_chip_file
from services.types import Array, BoolArray, IntArray, Progress, no_progress

LOWEST_M, HIGHEST_M = -500.0, 9000.0
SMALLEST_SIGMA_M, LARGEST_SIGMA_M = 1e-6, 1e6
OUTLINE_MARGIN_DEG = 1e-9
LISTED = 20
FILES_AT_ONCE = 4
CHIPS = "chips/"
ROWS_OF_ONE_KIND = 3


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong in a block.

    Attributes:
        file: path in the block.
        field: column or field, "" for the file itself.
        row: None when it is not about one row.
    """

    file: str
    field: str
    row: int | None
    found: str
    expected: str

    def __str__(self) -> str:
        where = f"{self.file}: {self.field}" if self.field else self.file
        row = "" if self.row is None else f": row {self.row}"
        return f"{where}{row}: {self.found} found, {self.expected} expected"


class BlockProblems(FormatError):
    """A block that cannot be used.

    Attributes:
        problems: the first of them.
        count: how many there are.
    """

    def __init__(self, problems: tuple[Problem, ...], count: int) -> None:
        lines = [str(problem) for problem in problems]
        if count > len(lines):
            lines.append(f"and {count - len(lines)} more")
        noun = "problem" if count == 1 else "problems"
        super().__init__(f"the block has {count} {noun}: " + "; ".join(lines))
        self.problems = problems
        self.count = count


def check_block(
    folder: Path, progress: Progress = no_progress, chip_checksums: bool = True
) -> BlockContents:
    """Validate a block folder entirely, and read it.

    Checked: checksums, missing and unlisted files, paths and links, columns and types, ranges,
    covariances, duplicates, the order of views, counts, shapes and types of the chip files, that views
    name existing chips, the specified number of views, and that points lie in the declared outline.

    Args:
        folder: of the block.
        progress: told while checksums are taken.
        chip_checksums: False for who copies the files of chips and takes their checksums on the way:
            passing over their bytes is most of the work. Everything else is checked.

    Raises:
        BlockProblems: with up to 20 problems, each with file, field, row, value and what was expected.
        FormatError: when block.json or a table cannot be read at all.
    """
    document = read_document(folder)
    later = set() if chip_checksums else {name for name in document.checksums if name.startswith(CHIPS)}
    report = _check_files(folder, document, later, progress)
    if report.count:
        _check_later(report, folder, document, later)
    report.raise_if_any()
    progress(1.0, "checking points and views")
    points, views = read_points(folder / POINTS_PARQUET), read_views(folder / VIEWS_PARQUET)
    report = _Report()
    _check_points(report, points, document)
    _check_order(report, points, views)
    report.raise_if_any()
    _check_views(report, points, views, document)
    _check_chips(report, folder, points, document)
    _check_later(report, folder, document, later - set(points.chip_files))
    report.raise_if_any()
    progress(1.0, "block checked")
    return assemble(document, points, views)


@dataclass
class _Report:
    problems: list[Problem] = field(default_factory=list)
    count: int = 0

    def add(self, file: str, field: str, found: str, expected: str, row: int | None = None) -> None:
        self.count += 1
        if len(self.problems) < LISTED:
            self.problems.append(Problem(file, field, row, found, expected))

    def rows(
        self, where: tuple[str, str], bad: BoolArray, values: npt.NDArray[Any], expected: str
    ) -> None:
        """Add the rows of a column that are bad: the first few by name, all of them in the count."""
        rows = np.flatnonzero(bad)
        for row in rows[:ROWS_OF_ONE_KIND]:
            self.add(*where, str(values[row]), expected, int(row))
        self.count += max(0, len(rows) - ROWS_OF_ONE_KIND)

    def raise_if_any(self) -> None:
        if self.count:
            raise BlockProblems(tuple(self.problems), self.count)


def check_checksums(found: Mapping[str, str], document: BlockDocument) -> None:
    """Compare checksums of files that were taken elsewhere with those that block.json promises.

    Args:
        found: checksum by path in the block.

    Raises:
        BlockProblems: naming the files whose bytes are others.
    """
    report = _Report()
    for name, checksum in found.items():
        _check_checksum(report, name, checksum, document.checksums[name])
    report.raise_if_any()


def _check_files(folder: Path, document: BlockDocument, later: Set[str], progress: Progress) -> _Report:
    """Which files there are, and the checksums of all but those that are left for later."""
    report = _Report()
    present = _files(folder, report)
    listed = set(document.checksums)
    named = {POINTS_PARQUET, VIEWS_PARQUET, *(model for model in document.models if model is not None)}
    for name in sorted(named - listed):
        report.add(BLOCK_JSON, "amers:checksums", f"no checksum of {name!r:.200}", "one of every file")
    for name in sorted(present - listed - {BLOCK_JSON}):
        report.add(name, "", "a file without a checksum", "only files listed in amers:checksums")
    for name in sorted(later - present):
        report.add(name, "", "no file", "the file listed in amers:checksums")
    names = sorted(listed - later)
    progress(0.0, "checking checksums")
    with ThreadPoolExecutor(FILES_AT_ONCE) as pool:
        for i, found in enumerate(pool.map(lambda name: _checksum(folder, name), names)):
            progress((i + 1) / len(names), "checking checksums")
            _check_checksum(report, names[i], found, document.checksums[names[i]])
    return report


def _check_later(report: _Report, folder: Path, document: BlockDocument, names: Set[str]) -> None:
    """The checksums that were left for later: who is refused hears of all that is wrong."""
    for name in sorted(names):
        if (folder / name).is_file():
            _check_checksum(report, name, _checksum(folder, name), document.checksums[name])


def _checksum(folder: Path, name: str) -> str | FormatError | None:
    """The checksum of a file of the block; None without the file, an error without a right to it."""
    try:
        path = block_member(folder, name)
    except FormatError as error:
        return error
    return file_sha256(path) if path.is_file() else None


def _check_checksum(report: _Report, name: str, found: str | FormatError | None, expected: str) -> None:
    if isinstance(found, FormatError):
        report.add(BLOCK_JSON, "amers:checksums", str(found), "a path inside the block")
    elif found is None:
        report.add(name, "", "no file", "the file listed in amers:checksums")
    elif found != expected.lower():
        report.add(name, "", f"sha256 {found}", f"{expected:.80}")


def _files(folder: Path, report: _Report) -> set[str]:
    present = set()
    for path in Path(folder).rglob("*"):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            report.add(name, "", "a link or special file", "plain files and folders")
        elif path.is_file():
            present.add(name)
    return present


def _check_points(report: _Report, points: PointRows, document: BlockDocument) -> None:
    n = len(points.id)
    if n != document.counts.points:
        report.add(
            BLOCK_JSON,
            "amers:counts.points",
            str(document.counts.points),
            f"{n}, rows of {POINTS_PARQUET}",
        )
    if n == 0:
        report.add(POINTS_PARQUET, "", "no points", "one at least")
    ids = (POINTS_PARQUET, "id")
    outside = (points.id < 0) | (points.id >= n)
    report.rows(ids, outside, points.id, f"0 to {n - 1}")
    report.rows(ids, ~outside & _repeated(points.id), points.id, "an id of one point only")
    _check_positions(report, points.lon_lat_h, document.metadata.extent)
    _check_spread(report, points)
    report.rows(
        (POINTS_PARQUET, "saliency"),
        ~((points.saliency >= 0.0) & (points.saliency <= 1.0)),
        points.saliency,
        "0 to 1",
    )
    report.rows((POINTS_PARQUET, "chip_count"), points.chip_count < 1, points.chip_count, "1 or more")
    least = document.metadata.specification.min_views
    report.rows(
        (POINTS_PARQUET, "n_views"),
        points.n_views < least,
        points.n_views,
        f"{least} or more, the specification's min_views",
    )
    known = ~(np.isnat(points.first_view) | np.isnat(points.last_view))
    report.rows(
        (POINTS_PARQUET, "first_view"),
        known & (points.first_view > points.last_view),
        points.first_view,
        "not after last_view",
    )


def _check_positions(report: _Report, lon_lat_h: Array, outline: Array) -> None:
    limits = (("lon", -180.0, 180.0), ("lat", -90.0, 90.0), ("height", LOWEST_M, HIGHEST_M))
    good = np.ones(len(lon_lat_h), dtype=np.bool_)
    for column, (name, low, high) in enumerate(limits):
        values = lon_lat_h[:, column]
        inside = (values >= low) & (values <= high)
        report.rows((POINTS_PARQUET, f"geometry {name}"), ~inside, values, f"{low:g} to {high:g}")
        good &= inside
    lon, lat = lon_lat_h[good, 0], lon_lat_h[good, 1]
    declared = shapely.Polygon(outline).buffer(OUTLINE_MARGIN_DEG, join_style="mitre")
    shapely.prepare(declared)
    within = np.zeros(len(lon), dtype=np.bool_)
    for turn in (-360.0, 0.0, 360.0):
        within |= shapely.intersects_xy(declared, lon + turn, lat)
    outside = np.zeros(len(lon_lat_h), dtype=np.bool_)
    outside[good] = ~within
    report.rows((POINTS_PARQUET, "geometry"), outside, lon_lat_h, "a position in the block's outline")


def _check_spread(report: _Report, points: PointRows) -> None:
    finite = (points.sigma_m >= SMALLEST_SIGMA_M) & (points.sigma_m <= LARGEST_SIGMA_M)
    expected = f"{SMALLEST_SIGMA_M:g} to {LARGEST_SIGMA_M:g} metres"
    for column, name in enumerate(("sigma_east_m", "sigma_north_m", "sigma_up_m")):
        values = points.sigma_m[:, column]
        report.rows((POINTS_PARQUET, name), ~finite[:, column], values, expected)
    good = np.abs(points.correlation) <= 1.0
    for column, name in enumerate(("corr_east_north", "corr_east_up", "corr_north_up")):
        values = points.correlation[:, column]
        report.rows((POINTS_PARQUET, name), ~good[:, column], values, "-1 to 1")
    en, eu, nu = points.correlation.T
    determinant = 1.0 - en**2 - eu**2 - nu**2 + 2.0 * en * eu * nu
    report.rows(
        (POINTS_PARQUET, "corr_*"),
        good.all(axis=1) & ~(determinant > 0.0),
        points.correlation,
        "correlations of a positive definite covariance",
    )


def _repeated(values: IntArray) -> BoolArray:
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return counts[inverse] > 1


def _check_order(report: _Report, points: PointRows, views: ViewRows) -> None:
    """Each point's views follow each other, as many as it has chips, in the order of the points."""
    count = np.maximum(points.chip_count, 0)
    owner = np.repeat(points.id, count)
    if len(owner) != len(views.point_id):
        report.add(
            VIEWS_PARQUET, "", f"{len(views.point_id)} rows", f"{len(owner)}, the sum of chip_count"
        )
        return
    report.rows(
        (VIEWS_PARQUET, "point_id"), owner != views.point_id, views.point_id, "the points in their order"
    )
    first = np.cumsum(count) - count
    within = np.arange(len(owner)) - np.repeat(first, count)
    report.rows((VIEWS_PARQUET, "view"), within != views.view, views.view, "0, 1, 2 … within a point")


def _check_views(report: _Report, points: PointRows, views: ViewRows, document: BlockDocument) -> None:
    """Views name their images and chips; their rows are known to follow the points by now."""
    if len(views.view) != document.counts.views:
        report.add(
            BLOCK_JSON,
            "amers:counts.views",
            str(document.counts.views),
            f"{len(views.view)}, rows of {VIEWS_PARQUET}",
        )
    names = [image.image_id for image in document.images]
    if len(names) != document.counts.images or len(set(names)) != len(names):
        report.add(
            BLOCK_JSON,
            "amers:images",
            f"{len(names)} images",
            f"{document.counts.images} different ones",
        )
    known = np.array([name in set(names) for name in views.image_ids], dtype=np.bool_)
    image_id = np.array(views.image_ids, dtype=object)[views.image]
    report.rows(
        (VIEWS_PARQUET, "image_id"),
        ~known[views.image],
        image_id,
        f"one of amers:images of {BLOCK_JSON}",
    )
    gsds = document.metadata.specification.gsds_m
    report.rows(
        (VIEWS_PARQUET, "gsd_m"),
        ~np.isclose(views.gsd_m[:, None], np.array(gsds)[None, :], rtol=1e-6, atol=0.0).any(axis=1),
        views.gsd_m,
        "one of " + ", ".join(f"{gsd:g}" for gsd in gsds),
    )
    coarser = np.diff(views.gsd_m, prepend=-np.inf) < 0.0
    report.rows(
        (VIEWS_PARQUET, "gsd_m"), coarser & (views.view > 0), views.gsd_m, "finest first within a point"
    )
    owner = np.repeat(np.arange(len(points.id)), points.chip_count)
    report.rows(
        (VIEWS_PARQUET, "chip_row"),
        views.chip_row != points.chip_row[owner] + views.view,
        views.chip_row,
        f"chip_row of the point in {POINTS_PARQUET} + view",
    )
    own_file = np.array(points.chip_files, dtype=object)[points.chip_file][owner]
    file = np.array(views.chip_files, dtype=object)[views.chip_file]
    report.rows(
        (VIEWS_PARQUET, "chip_file"), file != own_file, file, f"the file named in {POINTS_PARQUET}"
    )
    pairs = np.unique(np.column_stack([owner, views.image]), axis=0)
    seen = np.bincount(pairs[:, 0], minlength=len(points.id))
    report.rows(
        (POINTS_PARQUET, "n_views"),
        points.n_views != seen,
        points.n_views,
        "the number of images of its views",
    )


def _check_chips(report: _Report, folder: Path, points: PointRows, document: BlockDocument) -> None:
    dtypes: set[npt.DTypeLike] = set()
    for i, name in enumerate(points.chip_files):
        layout = _layout(report, folder, name, document)
        if layout is None:
            continue
        dtypes.add(layout.dtype)
        end = points.chip_row + points.chip_count
        beyond = (points.chip_file == i) & ((points.chip_row < 0) | (end > layout.count))
        expected = f"0 to {layout.count}, the chips of {name}, with chip_count"
        report.rows((POINTS_PARQUET, "chip_row"), beyond, points.chip_row, expected)
    if len(dtypes) > 1:
        report.add("chips", "", "uint8 and uint16", "one type of chips in a block")


def _layout(report: _Report, folder: Path, name: str, document: BlockDocument) -> ChipFile | None:
    if name not in document.checksums:
        report.add(POINTS_PARQUET, "chip_file", f"{name!r:.200}", "a file listed in amers:checksums")
        return None
    try:
        return read_chip_file(block_member(folder, name), name)
    except FormatError as error:
        report.add(name, "", str(error).removeprefix(f"{name}: "), "a file of chips")
        return None
