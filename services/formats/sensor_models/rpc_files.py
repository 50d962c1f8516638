"""The RPC of an image: where it is found, whose pixels it is in, and how a refined one is written."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from services.errors import FormatError
from services.formats.images.raster import RasterImage, copy_with_rpc, open_raster
from services.formats.sensor_models.dimap import format_dimap_rpc, parse_dimap_rpc
from services.formats.sensor_models.rpc_text import (
    format_rpb,
    format_rpc_text,
    parse_number,
    parse_rpb,
    parse_rpc_text,
    rpb_satellite,
    rpc_from_numbers,
)
from services.sensors.rpc import RpcModel, check_rpc

_RPC00A_ORDER = (0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 7, 11, 14, 17, 12, 15, 18, 13, 16, 19)
"""Where RPC00A has the terms of RPC00B; source: NGA STDI-0002."""

Convention = Literal["tags", "text", "rpb", "dimap"]

_MAX_TEXT_BYTES = 20_000_000
_CROP_EVIDENCE = 2.0
"""How many times nearer to the first pixel the range of a model has to start for a choice to be made."""


@dataclass(frozen=True)
class DeliveredModel:
    """The model an image came with, in the pixels of that image.

    Attributes:
        model: checked, (0, 0) is the centre of the first pixel of the image.
        path: the file it was read from.
        convention: how it was written there.
        crop_origin: line and sample of the image's first pixel in the image the file's model is for;
            what was taken from its image offsets.
        note: one sentence, where the model was found and why it was shifted or not.
    """

    model: RpcModel
    path: Path
    convention: Convention
    crop_origin: tuple[float, float]
    note: str


def read_rpc(
    path: Path, model_path: Path | None = None, crop_origin: tuple[float, float] | None = None
) -> DeliveredModel:
    """The RPC of an image, in the pixels of that image.

    Looked for in this order: `model_path`; the RPC tags of the GeoTIFF or the RPC00B of the NITF;
    `STEM_RPC.TXT`, `STEM.RPB`, `STEM_RPC.XML` beside the image, and for `IMG_NAME_R1C1` the
    `RPC_NAME.XML` of its DIMAP (capitals or not).

    A crop often keeps its place in the full scene as a geotransform of unit pixels without a reference
    system, and its model may be the full scene's or already be in the pixels of the crop. The range the
    model was fitted on, offset - scale to offset + scale, tells: it has to contain the image,
    and it starts near the first pixel of the full scene. Where that is not clear an explicit
    `crop_origin` is asked for.

    Args:
        path: of the image.
        model_path: `_RPC.TXT`, `.RPB` or DIMAP file, whatever its name; found by default.
        crop_origin: line and sample of the image's first pixel in the image the model is for;
            (0, 0) when the model is in the pixels of the image; found out by default.

    Raises:
        FormatError: without a usable model; the message says what was looked for.
    """
    image = open_raster(path)
    try:
        return model_of_image(image, model_path, crop_origin)
    finally:
        image.close()


def write_model(
    delivered: DeliveredModel | None, model: RpcModel, folder: Path, image_path: Path | None = None
) -> list[Path]:
    """Write a refined model as `refined_RPC.TXT` and in the convention of the model it refines.

    Both are in the pixels of the image that was read: the model of a crop stays that of the crop,
    even where the delivered one was the full scene's. A file keeps its name; RPC tags become the
    `STEM_RPC.TXT` that GDAL prefers to them when it lies beside the image, and go into a copy of the
    image only when `image_path` is given.

    Args:
        delivered: the model as read; None for one of another kind, which only leaves the text.
        model: the refined one.
        folder: where to write; made when missing.
        image_path: the image, to have a copy of it with the refined model in its tags.

    Returns:
        The files written.

    Raises:
        FormatError: when a file that was delivered would be written over.
    """
    folder.mkdir(parents=True, exist_ok=True)
    texts = {"refined_RPC.TXT": format_rpc_text(model)}
    if delivered is not None:
        texts |= _in_own_convention(delivered, model)
    written = []
    for name, text in texts.items():
        target = folder / name
        if delivered is not None and target.resolve() == delivered.path.resolve():
            raise FormatError(f"{target}: the delivered model would be written over")
        target.write_bytes(text.encode(_encoding(text)))
        written.append(target)
    if image_path is not None:
        copy_with_rpc(image_path, folder / image_path.name, model)
        written.append(folder / image_path.name)
    return written


def _in_own_convention(delivered: DeliveredModel, model: RpcModel) -> dict[str, str]:
    """The file that takes the place of the delivered one, by its name."""
    path = delivered.path
    if delivered.convention == "rpb":
        return {path.name: format_rpb(model, rpb_satellite(read_text(path)))}
    if delivered.convention == "dimap":
        return {path.name: format_dimap_rpc(read_text(path), model, path.name)}
    name = f"{path.stem}_RPC.TXT" if delivered.convention == "tags" else path.name
    return {name: format_rpc_text(model)}


def model_of_image(
    image: RasterImage, model_path: Path | None, crop_origin: tuple[float, float] | None
) -> DeliveredModel:
    """`read_rpc` for an image that is open."""
    if model_path is not None:
        model, path, convention = _read_model_file(model_path)
    else:
        model, path, convention = _find_model(image)
    check_rpc(model, path.name)
    placed = _placed_at(image)
    tile = re.search(r"_R(\d+)C(\d+)$", image.path.stem, re.IGNORECASE)
    if crop_origin is not None:
        origin, reason = crop_origin, "shifted as told" if any(crop_origin) else "as told"
    elif placed is not None:
        origin, reason = _choose_origin(model, placed, image)
    elif tile and convention == "dimap" and (int(tile[1]), int(tile[2])) != (1, 1):
        raise FormatError(
            f"{image.path}: a tile of an image in several files, whose RPC is for the whole: give the "
            "place of its first pixel in the whole as crop_origin=(line, sample)"
        )
    else:
        origin, reason = (0.0, 0.0), "in the pixels of the image"
    model = replace(model, image_offset=model.image_offset - np.array(origin))
    _check_coverage(model, image, path)
    return DeliveredModel(model, path, convention, origin, f"{convention} of {path.name}, {reason}")


def has_rpc(image: RasterImage) -> bool:
    """Whether an image has RPC tags, or a file beside it that is named like its RPC."""
    return bool(image.dataset.tags(ns="RPC")) or bool(_files_beside(image)[1])


def _find_model(image: RasterImage) -> tuple[RpcModel, Path, Convention]:
    tags = image.dataset.tags(ns="RPC")
    if tags:
        records = image.dataset.tags(ns="TRE")
        if "RPC00A" in records and "RPC00B" not in records:
            tags = {**tags, **_rpc00a_coefficients(records["RPC00A"])}
        return _parse_tags(tags, image.path.name), image.path, "tags"
    names, found = _files_beside(image)
    if found:
        return _read_model_file(found[0])
    raise FormatError(
        f"{image.path}: no sensor model: the file lies on no map and has no RPC tags, and there is no "
        f"{', '.join(names)} beside it"
    )


def _files_beside(image: RasterImage) -> tuple[list[str], list[Path]]:
    """The names an image's RPC may have, and the files beside it that have one of them."""
    stem = image.path.stem
    names = [f"{stem}_RPC.TXT", f"{stem}.RPB", f"{stem}_RPC.XML"]
    airbus = re.fullmatch(r"IMG_(.+?)(_R\d+C\d+)?", stem, re.IGNORECASE)
    if airbus is not None:
        names.append(f"RPC_{airbus[1]}.XML")
    beside = {file.name.upper(): file for file in image.path.resolve().parent.iterdir()}
    return names, [beside[name.upper()] for name in names if name.upper() in beside]


def _read_model_file(path: Path) -> tuple[RpcModel, Path, Convention]:
    """A model file; what it holds decides, not its name."""
    text = read_text(path)
    if text.lstrip("\ufeff \t\r\n").startswith("<"):
        return parse_dimap_rpc(text, path.name), path, "dimap"
    if re.search(r"\bBEGIN_GROUP\b", text):
        return parse_rpb(text, path.name), path, "rpb"
    return parse_rpc_text(text, path.name), path, "text"


def _rpc00a_coefficients(record: str) -> dict[str, str]:
    """The coefficients of an RPC00A record in the order of RPC00B.

    Read from the record itself: GDAL mistakes four of the terms of the second degree.
    """
    starts = {"LINE_NUM": 81, "LINE_DEN": 321, "SAMP_NUM": 561, "SAMP_DEN": 801}
    return {
        f"{name}_COEFF": " ".join(record[start + 12 * i : start + 12 * (i + 1)] for i in _RPC00A_ORDER)
        for name, start in starts.items()
    }


def _parse_tags(tags: dict[str, str], source: str) -> RpcModel:
    def number(key: str) -> float:
        name, _, index = key.partition("_COEFF_")
        if key in ("ERR_BIAS", "ERR_RAND"):
            return parse_number(tags.get(key, "-1"), key, source)
        values = tags.get(f"{name}_COEFF" if index else key, "").split()
        if len(values) != (20 if index else 1):
            raise FormatError(f"{source}: the RPC tags have no {key}")
        return parse_number(values[int(index) - 1 if index else 0], key, source)

    return rpc_from_numbers(number)


def _placed_at(image: RasterImage) -> tuple[float, float] | None:
    """Line and sample of the first pixel in a full scene, when the image says it is a crop of one."""
    t = image.dataset.transform
    unit = (t.a, t.b, t.d, t.e) == (1.0, 0.0, 0.0, 1.0)
    if image.dataset.crs is not None or not unit or (t.c, t.f) == (0.0, 0.0):
        return None
    return t.f, t.c


def _choose_origin(
    model: RpcModel, placed: tuple[float, float], image: RasterImage
) -> tuple[tuple[float, float], str]:
    """Whether a model is for the full scene a crop is placed in, or for the crop."""
    start = model.image_offset - model.image_scale
    end = model.image_offset + model.image_scale
    margin = 0.1 * model.image_scale
    last = np.array(image.shape) - 1.0
    contains, distance = [], []
    for origin in (np.zeros(2), np.array(placed)):
        contains.append(bool((origin >= start - margin).all() and (origin + last <= end + margin).all()))
        distance.append(float(np.hypot(*(start + np.array(placed) - origin))))
    crop, full = contains
    if crop and full:
        crop = distance[0] * _CROP_EVIDENCE < distance[1]
        full = distance[1] * _CROP_EVIDENCE < distance[0]
    where = f"line {placed[0]:g}, sample {placed[1]:g}"
    if crop and not full:
        return (0.0, 0.0), f"already in the pixels of the crop at {where}"
    if full and not crop:
        return placed, f"of the full scene, shifted to the crop at {where}"
    raise FormatError(
        f"{image.path}: a crop at {where}, and its RPC, for lines {start[0]:g} to {end[0]:g} and "
        f"samples {start[1]:g} to {end[1]:g}, may be for the crop or for the full scene: say which, "
        f"crop_origin=(0, 0) or crop_origin=({placed[0]:g}, {placed[1]:g})"
    )


def _check_coverage(model: RpcModel, image: RasterImage, path: Path) -> None:
    """A model that cannot locate the image is not the image's."""
    lines, samples = image.shape
    corners = np.array([[0, 0], [0, samples - 1], [lines - 1, samples - 1], [lines - 1, 0]], float)
    height_m = np.full(4, sum(model.height_range_m) / 2.0)
    outside = int(np.isnan(model.locate(corners, height_m)[:, 0]).sum())
    if outside:
        raise FormatError(
            f"{path.name}: the RPC does not cover the image {image.path.name}: {outside} of its 4 "
            "corners are outside the ground it is for"
        )


def read_text(path: Path) -> str:
    """A small text file, UTF-8, or Latin-1 where it is not.

    Raises:
        FormatError: when it cannot be read, or is larger than any such file.
    """
    try:
        if not path.is_file() or path.stat().st_size > _MAX_TEXT_BYTES:
            raise FormatError(f"{path}: expected a text file of at most {_MAX_TEXT_BYTES} bytes")
        data = path.read_bytes()
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _encoding(text: str) -> str:
    """UTF-8, unless an XML document declares Latin-1."""
    declared = re.match(r"\s*<\?xml[^>]*encoding=[\"']ISO-8859-1[\"']", text, re.IGNORECASE)
    return "latin-1" if declared else "utf-8"
