"""Validation of an Amers block: every requirement of the format, before any of its content is used."""

from collections.abc import Mapping, Set
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy.typing as npt

from amers.services.errors import FormatError
from amers.services.formats.block.document import BlockDocument
from amers.services.formats.block.document_json import BLOCK_JSON
from amers.services.formats.block.problems import ProblemReport
from amers.services.formats.block.reader import (
    BlockContents,
    block_contents,
    block_member,
    file_sha256,
    read_document,
)
from amers.services.formats.block.row_checks import check_order, check_points, check_views
from amers.services.formats.block.tables import (
    POINTS_PARQUET,
    VIEWS_PARQUET,
    PointRows,
    read_points,
    read_views,
)
from amers.services.formats.chips.npy_files import ChipFile, read_chip_file
from amers.services.types import Progress, no_progress

CHECKSUM_THREADS = 4
CHIP_FOLDER = "chips/"


def check_block(
    folder: Path, progress: Progress = no_progress, chip_checksums: bool = True
) -> BlockContents:
    """The content of a block folder, after a complete validation.

    Checks: checksums, missing and unlisted files, paths and links, columns and types, ranges,
    covariances, duplicates, the order of views, counts, shapes and types of the chip files, that each
    view names an existing chip, the specified number of views, and that points lie in the outline.

    Args:
        folder: of the block.
        progress: reports the progress of computing checksums.
        chip_checksums: False skips the checksums of the chip files, which are most of the work, for a
            caller that computes them while copying the files (see `check_checksums`).

    Raises:
        BlockProblems: with up to 20 problems, each with file, field, row, value and what was expected.
        FormatError: `block.json` or a table cannot be read.
    """
    document = read_document(folder)
    deferred = set() if chip_checksums else {n for n in document.checksums if n.startswith(CHIP_FOLDER)}
    report = _check_files(folder, document, deferred, progress)
    if report.count:
        _check_deferred(report, folder, document, deferred)
    report.raise_if_any()
    progress(1.0, "checking points and views")
    points = read_points(folder / POINTS_PARQUET, document.counts.points)
    views = read_views(folder / VIEWS_PARQUET, document.counts.views)
    report = ProblemReport()
    check_points(report, points, document)
    check_order(report, points, views)
    report.raise_if_any()
    check_views(report, points, views, document)
    _check_chips(report, folder, points, document)
    _check_deferred(report, folder, document, deferred - set(points.chip_files))
    report.raise_if_any()
    progress(1.0, "block checked")
    return block_contents(document, points, views)


def check_checksums(computed: Mapping[str, str], document: BlockDocument) -> None:
    """Compare checksums that the caller computed with those in `block.json`.

    Args:
        computed: SHA-256 by path in the block.
        document: content of `block.json`.

    Raises:
        BlockProblems: checksums differ; the message names the files.
    """
    report = ProblemReport()
    for name, checksum in computed.items():
        _check_checksum(report, name, checksum, document.checksums[name])
    report.raise_if_any()


def _check_files(
    folder: Path, document: BlockDocument, deferred: Set[str], progress: Progress
) -> ProblemReport:
    """The problems with the list of files, and with the checksums of all files not deferred."""
    report = ProblemReport()
    present = _regular_files(folder, report)
    listed = set(document.checksums)
    named = {POINTS_PARQUET, VIEWS_PARQUET, *(model for model in document.models if model is not None)}
    for name in sorted(named - listed):
        report.add(
            BLOCK_JSON, "amers:checksums", f"no checksum of {name!r:.200}", "a checksum of every file"
        )
    for name in sorted(present - listed - {BLOCK_JSON}):
        report.add(name, "", "a file without a checksum", "only files listed in amers:checksums")
    for name in sorted(deferred - present):
        report.add(name, "", "no file", "the file listed in amers:checksums")
    names = sorted(listed - deferred)
    progress(0.0, "checking checksums")
    with ThreadPoolExecutor(CHECKSUM_THREADS) as pool:
        for i, checksum in enumerate(pool.map(lambda name: _checksum(folder, name), names)):
            progress((i + 1) / len(names), "checking checksums")
            _check_checksum(report, names[i], checksum, document.checksums[names[i]])
    return report


def _check_deferred(
    report: ProblemReport, folder: Path, document: BlockDocument, names: Set[str]
) -> None:
    """Check the deferred checksums of a block that is refused, so that its report is complete."""
    for name in sorted(names):
        if (folder / name).is_file():
            _check_checksum(report, name, _checksum(folder, name), document.checksums[name])


def _checksum(folder: Path, name: str) -> str | FormatError | None:
    """SHA-256 of a file of the block; None when it is missing, an error when its path is not allowed."""
    try:
        path = block_member(folder, name)
    except FormatError as error:
        return error
    return file_sha256(path) if path.is_file() else None


def _check_checksum(
    report: ProblemReport, name: str, actual: str | FormatError | None, expected: str
) -> None:
    if isinstance(actual, FormatError):
        report.add(
            BLOCK_JSON, "amers:checksums", f"{name!r:.200}", "a path inside the block, without links"
        )
    elif actual is None:
        report.add(name, "", "no file", "the file listed in amers:checksums")
    elif actual != expected.lower():
        report.add(name, "", f"sha256 {actual}", f"{expected:.80}")


def _regular_files(folder: Path, report: ProblemReport) -> set[str]:
    """Paths in the block of all plain files; anything else becomes a problem."""
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
        layout = _chip_file(report, folder, name, document)
        if layout is None:
            continue
        dtypes.add(layout.dtype)
        end = points.chip_row + points.chip_count
        beyond = (points.chip_file == i) & ((points.chip_row < 0) | (end > layout.count))
        expected = f"chip_row to chip_row + chip_count within the {layout.count} chips of {name}"
        report.rows((POINTS_PARQUET, "chip_row"), beyond, points.chip_row, expected)
    if len(dtypes) > 1:
        report.add("chips", "", "uint8 and uint16", "the same type for all chips of a block")


def _chip_file(
    report: ProblemReport, folder: Path, name: str, document: BlockDocument
) -> ChipFile | None:
    if name not in document.checksums:
        report.add(POINTS_PARQUET, "chip_file", f"{name!r:.200}", "a file listed in amers:checksums")
        return None
    try:
        return read_chip_file(block_member(folder, name), name)
    except FormatError as error:
        report.add(name, "", str(error).removeprefix(f"{name}: "), "a file of chips")
        return None
