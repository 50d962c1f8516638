"""Everything an Amers block promises, checked before anything of it is used."""

from collections.abc import Mapping, Set
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy.typing as npt

from services.errors import FormatError
from services.formats.block.document import BlockDocument
from services.formats.block.document_json import BLOCK_JSON
from services.formats.block.problems import ProblemReport
from services.formats.block.reader import (
    BlockContents,
    assemble,
    block_member,
    file_sha256,
    read_document,
)
from services.formats.block.row_checks import check_order, check_points, check_views
from services.formats.block.tables import (
    POINTS_PARQUET,
    VIEWS_PARQUET,
    PointRows,
    read_points,
    read_views,
)
from services.formats.chips.npy_files import ChipFile, read_chip_file
from services.types import Progress, no_progress

FILES_AT_ONCE = 4
CHIPS = "chips/"


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
    report = ProblemReport()
    check_points(report, points, document)
    check_order(report, points, views)
    report.raise_if_any()
    check_views(report, points, views, document)
    _check_chips(report, folder, points, document)
    _check_later(report, folder, document, later - set(points.chip_files))
    report.raise_if_any()
    progress(1.0, "block checked")
    return assemble(document, points, views)


def check_checksums(found: Mapping[str, str], document: BlockDocument) -> None:
    """Compare checksums of files that were taken elsewhere with those that block.json promises.

    Args:
        found: checksum by path in the block.

    Raises:
        BlockProblems: naming the files whose bytes are others.
    """
    report = ProblemReport()
    for name, checksum in found.items():
        _check_checksum(report, name, checksum, document.checksums[name])
    report.raise_if_any()


def _check_files(
    folder: Path, document: BlockDocument, later: Set[str], progress: Progress
) -> ProblemReport:
    """Which files there are, and the checksums of all but those that are left for later."""
    report = ProblemReport()
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


def _check_later(report: ProblemReport, folder: Path, document: BlockDocument, names: Set[str]) -> None:
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


def _check_checksum(
    report: ProblemReport, name: str, found: str | FormatError | None, expected: str
) -> None:
    if isinstance(found, FormatError):
        report.add(BLOCK_JSON, "amers:checksums", str(found), "a path inside the block")
    elif found is None:
        report.add(name, "", "no file", "the file listed in amers:checksums")
    elif found != expected.lower():
        report.add(name, "", f"sha256 {found}", f"{expected:.80}")


def _files(folder: Path, report: ProblemReport) -> set[str]:
    present = set()
    for path in Path(folder).rglob("*"):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            report.add(name, "", "a link or special file", "plain files and folders")
        elif path.is_file():
            present.add(name)
    return present


def _check_chips(
    report: ProblemReport, folder: Path, points: PointRows, document: BlockDocument
) -> None:
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


def _layout(report: ProblemReport, folder: Path, name: str, document: BlockDocument) -> ChipFile | None:
    if name not in document.checksums:
        report.add(POINTS_PARQUET, "chip_file", f"{name!r:.200}", "a file listed in amers:checksums")
        return None
    try:
        return read_chip_file(block_member(folder, name), name)
    except FormatError as error:
        report.add(name, "", str(error).removeprefix(f"{name}: "), "a file of chips")
        return None
