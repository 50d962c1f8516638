"""Writing an Amers block: all its files, and `block.json` last.

The files go into a temporary folder, which is renamed when it is complete: an interrupted run leaves
nothing that could be taken for a block.
"""

import hashlib
import re
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amers.services.conventions import CHIP_SIZE
from amers.services.errors import FormatError, InputError
from amers.services.formats.block.document import NAME_PATTERN, BlockCounts, BlockDocument, BlockMetadata
from amers.services.formats.block.document_json import BLOCK_JSON, format_block_json
from amers.services.formats.block.hilbert import hilbert_order
from amers.services.formats.block.reader import file_sha256
from amers.services.formats.block.tables import (
    POINTS_PARQUET,
    VIEWS_PARQUET,
    Dates,
    PointRows,
    Texts,
    ViewRows,
    sigmas_from_covariance,
    write_points,
    write_views,
)
from amers.services.formats.chips.npy_files import CHIP_DTYPES, chip_file_header
from amers.services.formats.sensor_models.rpc_text import format_rpc_text
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Acquisition, ChipArray, ControlPoints, IntArray, Progress, no_progress

CHIP_FILE_BYTES = 512 * 2**20
"""Largest size of a file of chips; chips beyond it go into the next file."""
IMAGE_ID_PATTERN = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,199}")
"""Pattern of the names of images with a model: the file of the model has this name."""


def write_block(
    folder: Path,
    metadata: BlockMetadata,
    points: ControlPoints,
    chips: Callable[[int], ChipArray],
    models: Mapping[str, RpcModel],
    *,
    typology: Sequence[str | None] | None = None,
    progress: Progress = no_progress,
) -> IntArray:
    """Write a block folder, with the points in Hilbert order and numbered from 0 in this order.

    Args:
        folder: must not exist.
        metadata: description of the block by its producer.
        points: in any order; `id`, `chip_file`, `chip_row` and `chip_files` are not used.
        chips: returns the chips (views, 101, 101) of one row of `points`, in the order of its views;
            uint8 or uint16, the same for all points. Called once for each point, in writing order.
        models: adjusted model of each image that has one, by image_id.
        typology: kind of detail of each point.
        progress: reports the progress of writing chips.

    Returns:
        (n,) the row of `points` of each point in the block.

    Raises:
        InputError: the folder exists, there are no points, or a name is not usable as a file name.
        FormatError: chips have another shape or type than expected.
    """
    folder = Path(folder)
    if folder.exists():
        raise InputError(
            f"{folder}: the folder exists already, and a block is never overwritten; "
            "give the name of a new folder"
        )
    if len(points) == 0:
        raise InputError(f"{folder}: 0 points given, a block needs at least one")
    _check_names(metadata, models)
    order = hilbert_order(points.lon_lat_h[:, :2])
    partial = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.partial")
    (partial / "chips").mkdir(parents=True)
    try:
        layout = _write_chips(partial, np.diff(points.views.start)[order], order, chips, progress)
        typology_column = _typology_column(typology, len(points))[order]
        _write_tables(partial, points.take(order), layout, typology_column)
        paths = _write_models(partial, points.views.images, models)
        document = BlockDocument(
            metadata=metadata,
            counts=BlockCounts(len(points), len(points.views.gsd_m), len(points.views.images)),
            images=points.views.images,
            models=paths,
            checksums=layout.checksums | _checksums(partial, excluding=layout.checksums),
        )
        (partial / BLOCK_JSON).write_text(format_block_json(document), encoding="utf-8")
        partial.rename(folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    progress(1.0, "block written")
    return order


@dataclass(frozen=True)
class _ChipLayout:
    """File and first row of the chips of each written point, and names and checksums of the files."""

    file: IntArray
    row: IntArray
    names: tuple[str, ...]
    checksums: dict[str, str]


def _check_names(metadata: BlockMetadata, models: Mapping[str, RpcModel]) -> None:
    if not NAME_PATTERN.fullmatch(metadata.id):
        raise InputError(
            f"name of the block: {metadata.id!r:.120} given, a letter followed by letters, digits, "
            "dots, dashes or underscores expected"
        )
    for name in models:
        if not IMAGE_ID_PATTERN.fullmatch(name):
            raise InputError(
                f"name of an image: {name!r:.200} given, letters, digits, dots, dashes or underscores "
                "expected: the file of its model has this name"
            )


def _write_chips(
    folder: Path,
    counts: IntArray,
    order: IntArray,
    chips: Callable[[int], ChipArray],
    progress: Progress,
) -> _ChipLayout:
    """Write the chips of all points into files of at most `CHIP_FILE_BYTES`."""
    first = np.asarray(chips(int(order[0])))
    if first.dtype not in CHIP_DTYPES:
        raise FormatError(f"type of the chips: {first.dtype} given, uint8 or uint16 expected")
    chip_bytes = CHIP_SIZE * CHIP_SIZE * first.dtype.itemsize
    file, row = _plan_files(counts, CHIP_FILE_BYTES // chip_bytes)
    names = tuple(f"chips/{i:04d}.npy" for i in range(int(file[-1]) + 1))
    checksums = {}

    def chips_of(members: IntArray) -> Iterator[ChipArray]:
        for i in members:
            array = first if i == 0 else np.asarray(chips(int(order[i])))
            expected = (counts[i], CHIP_SIZE, CHIP_SIZE)
            if array.shape != expected or array.dtype != first.dtype:
                raise FormatError(
                    f"chips of point {order[i]}: {array.dtype} {array.shape} given, "
                    f"{first.dtype} {tuple(int(v) for v in expected)} expected"
                )
            if i % 256 == 0:
                progress(i / len(counts), "writing chips")
            yield array

    for i, name in enumerate(names):
        members = np.flatnonzero(file == i)
        header = chip_file_header(first.dtype, int(counts[members].sum()))
        checksums[name] = _write_hashed(folder / name, header, chips_of(members))
    return _ChipLayout(file, row, names, checksums)


def _plan_files(counts: IntArray, limit: int) -> tuple[IntArray, IntArray]:
    """File (n,) and first row (n,) of the chips of each point, with at most `limit` chips in a file."""
    file, row = np.empty(len(counts), dtype=np.int64), np.empty(len(counts), dtype=np.int64)
    current, used = 0, 0
    for i, count in enumerate(counts.tolist()):
        if used and used + count > limit:
            current, used = current + 1, 0
        file[i], row[i] = current, used
        used += count
    return file, row


def _write_hashed(path: Path, header: bytes, arrays: Iterator[ChipArray]) -> str:
    digest = hashlib.sha256(header)
    with path.open("wb") as out:
        out.write(header)
        for array in arrays:
            data = np.ascontiguousarray(array).data
            digest.update(data)
            out.write(data)
    return digest.hexdigest()


def _write_tables(folder: Path, points: ControlPoints, layout: _ChipLayout, typology: Texts) -> None:
    views = points.views
    count = np.diff(views.start)
    within = np.arange(len(views.gsd_m)) - np.repeat(views.start[:-1], count)
    owner = np.repeat(np.arange(len(points)), count)
    n_views, first_view, last_view = _view_statistics(points)
    sigma_m, correlation = sigmas_from_covariance(points.covariance_m2)
    rows = PointRows(
        id=np.arange(len(points), dtype=np.int64),
        lon_lat_h=points.lon_lat_h,
        sigma_m=sigma_m,
        correlation=correlation,
        n_views=n_views,
        saliency=points.saliency,
        typology=typology,
        first_view=first_view,
        last_view=last_view,
        chip_file=layout.file,
        chip_row=layout.row,
        chip_count=count,
        chip_files=layout.names,
        surface=points.surface,
    )
    write_points(folder / POINTS_PARQUET, rows)
    view_rows = ViewRows(
        point_id=owner,
        view=within,
        gsd_m=views.gsd_m,
        image=views.image,
        incidence_deg=views.incidence_deg,
        azimuth_deg=views.azimuth_deg,
        chip_file=layout.file[owner],
        chip_row=layout.row[owner] + within,
        image_ids=tuple(image.image_id for image in views.images),
        chip_files=layout.names,
    )
    write_views(folder / VIEWS_PARQUET, view_rows, views.images)


def _view_statistics(points: ControlPoints) -> tuple[IntArray, Dates, Dates]:
    """Number of distinct images of each point, and the dates of the first and the last one."""
    views = points.views
    owner = np.repeat(np.arange(len(points)), np.diff(views.start))
    pairs = np.unique(np.column_stack([owner, views.image]), axis=0)
    n_views = np.bincount(pairs[:, 0], minlength=len(points)).astype(np.int64)
    days = np.array(
        [
            np.datetime64("NaT")
            if image.acquired_at is None
            else np.datetime64(image.acquired_at.date())
            for image in views.images
        ],
        dtype="datetime64[D]",
    )[pairs[:, 1]]
    first = np.full(len(points), np.datetime64("NaT"), dtype="datetime64[D]")
    last = first.copy()
    np.fmin.at(first, pairs[:, 0], days)
    np.fmax.at(last, pairs[:, 0], days)
    return n_views, first, last


def _write_models(
    folder: Path, images: tuple[Acquisition, ...], models: Mapping[str, RpcModel]
) -> tuple[str | None, ...]:
    unseen = sorted(set(models) - {image.image_id for image in images})
    if unseen:
        raise InputError(f"models: {unseen[0]!r} given, the name of an image with views expected")
    paths: list[str | None] = []
    for image in images:
        model = models.get(image.image_id)
        paths.append(None if model is None else f"models/{image.image_id}_RPC.TXT")
        if model is not None:
            (folder / "models").mkdir(exist_ok=True)
            (folder / f"models/{image.image_id}_RPC.TXT").write_text(format_rpc_text(model))
    return tuple(paths)


def _checksums(folder: Path, excluding: Mapping[str, str]) -> dict[str, str]:
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    return {name: file_sha256(folder / name) for name in names if name not in excluding}


def _typology_column(values: Sequence[str | None] | None, count: int) -> Texts:
    texts = np.full(count, None, dtype=object)
    if values is not None:
        if len(values) != count:
            raise InputError(
                f"typology: {len(values)} values given, one for each of the {count} points expected"
            )
        texts[:] = values
    return texts
