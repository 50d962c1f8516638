"""An Amers block written: all its files, and `block.json` last.

The folder takes its name only when it is complete: a broken run leaves nothing that looks like a block.
"""

import hashlib
import re
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from services.conventions import CHIP_SIZE
from services.errors import FormatError, InputError
from services.formats.block.document import NAME_PATTERN, BlockCounts, BlockDocument, BlockMetadata
from services.formats.block.document_json import BLOCK_JSON, format_block_json
from services.formats.block.hilbert import hilbert_order
from services.formats.block.reader import file_sha256
from services.formats.block.tables import (
    POINTS_PARQUET,
    VIEWS_PARQUET,
    Dates,
    PointRows,
    Texts,
    ViewRows,
    spread_from_covariance,
    write_points,
    write_views,
)
from services.formats.chips.npy_files import CHIP_DTYPES, chip_file_header
from services.formats.sensor_models.rpc_text import format_rpc_text
from services.sensors.rpc import RpcModel
from services.types import Acquisition, ChipArray, ControlPoints, IntArray, Progress, no_progress

CHIP_FILE_BYTES = 512 * 2**20
IMAGE_ID_PATTERN = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,199}")
"""Names of images with a model: they become names of files."""


def write_block(
    folder: Path,
    metadata: BlockMetadata,
    points: ControlPoints,
    chips: Callable[[int], ChipArray],
    models: Mapping[str, RpcModel],
    typology: Sequence[str | None] | None = None,
    progress: Progress = no_progress,
) -> IntArray:
    """Write a block folder; points are put in Hilbert order and numbered in it, from 0.

    Args:
        folder: must not exist.
        metadata: what the producer says.
        points: in any order; `id`, `chip_file`, `chip_row` and `chip_files` are not read.
        chips: gives the chips (views, 101, 101) of the point of a row of `points`, in the order of its
            views; uint8 or uint16, the same for all. Called once a point, in the order of writing.
        models: adjusted model of each image that has one, by image_id.
        typology: kind of detail of each point.
        progress: told while chips are written.

    Returns:
        (n,) the row of `points` that each written point comes from.

    Raises:
        InputError: the folder exists, there are no points, or a name cannot be a name of a file.
        FormatError: chips of another shape or type than expected.
    """
    folder = Path(folder)
    if folder.exists():
        raise InputError(f"{folder} exists already: a block is never overwritten")
    if len(points) == 0:
        raise InputError("a block needs one point at least, 0 given")
    _check_names(metadata, models)
    order = hilbert_order(points.lon_lat_h[:, :2])
    partial = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.partial")
    (partial / "chips").mkdir(parents=True)
    try:
        place = _write_chips(partial, np.diff(points.views.start)[order], order, chips, progress)
        _write_tables(partial, points.take(order), place, _texts(typology, len(points))[order])
        paths = _write_models(partial, points.views.images, models)
        document = BlockDocument(
            metadata=metadata,
            counts=BlockCounts(len(points), len(points.views.gsd_m), len(points.views.images)),
            images=points.views.images,
            models=paths,
            checksums=place.checksums | _checksums(partial, excluding=place.checksums),
        )
        (partial / BLOCK_JSON).write_text(format_block_json(document), encoding="utf-8")
        partial.rename(folder)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    progress(1.0, "block written")
    return order


@dataclass(frozen=True)
class _ChipPlaces:
    """Where the chips of each written point went, and the checksums of the files."""

    file: IntArray
    row: IntArray
    names: tuple[str, ...]
    checksums: dict[str, str]


def _check_names(metadata: BlockMetadata, models: Mapping[str, RpcModel]) -> None:
    if not NAME_PATTERN.fullmatch(metadata.id):
        raise InputError(
            f"{metadata.id!r:.120}: a block is named by a letter, then letters, digits, dots, dashes, "
            "underscores"
        )
    for name in models:
        if not IMAGE_ID_PATTERN.fullmatch(name):
            raise InputError(f"the name of an image cannot be the name of a file: {name!r:.200}")


def _write_chips(
    folder: Path,
    counts: IntArray,
    order: IntArray,
    chips: Callable[[int], ChipArray],
    progress: Progress,
) -> _ChipPlaces:
    """Write the chips of all points, in files whose sizes are known before."""
    first = np.asarray(chips(int(order[0])))
    if first.dtype not in CHIP_DTYPES:
        raise FormatError(f"chips of type {first.dtype} given, uint8 or uint16 expected")
    chip_bytes = CHIP_SIZE * CHIP_SIZE * first.dtype.itemsize
    file, row = _planned(counts, CHIP_FILE_BYTES // chip_bytes)
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
    return _ChipPlaces(file, row, names, checksums)


def _planned(counts: IntArray, limit: int) -> tuple[IntArray, IntArray]:
    """File and first row of each point's chips, so that no file holds more than `limit` chips."""
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


def _write_tables(folder: Path, points: ControlPoints, place: _ChipPlaces, typology: Texts) -> None:
    views = points.views
    count = np.diff(views.start)
    within = np.arange(len(views.gsd_m)) - np.repeat(views.start[:-1], count)
    owner = np.repeat(np.arange(len(points)), count)
    n_views, first_view, last_view = _seen(points)
    sigma_m, correlation = spread_from_covariance(points.covariance_m2)
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
        chip_file=place.file,
        chip_row=place.row,
        chip_count=count,
        chip_files=place.names,
    )
    write_points(folder / POINTS_PARQUET, rows)
    view_rows = ViewRows(
        point_id=owner,
        view=within,
        gsd_m=views.gsd_m,
        image=views.image,
        incidence_deg=views.incidence_deg,
        azimuth_deg=views.azimuth_deg,
        chip_file=place.file[owner],
        chip_row=place.row[owner] + within,
        image_ids=tuple(image.image_id for image in views.images),
        chip_files=place.names,
    )
    write_views(folder / VIEWS_PARQUET, view_rows, views.images)


def _seen(points: ControlPoints) -> tuple[IntArray, Dates, Dates]:
    """Number of different images of each point, and the dates of its first and last one."""
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
    unknown = sorted(set(models) - {image.image_id for image in images})
    if unknown:
        raise InputError(f"a model is given for {unknown[0]!r}, which no view is of")
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


def _texts(values: Sequence[str | None] | None, count: int) -> Texts:
    texts = np.full(count, None, dtype=object)
    if values is not None:
        if len(values) != count:
            raise InputError(f"{len(values)} typologies given for {count} points")
        texts[:] = values
    return texts
