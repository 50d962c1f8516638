"""The RPC of an image: finding it, converting it to the pixels of the image, writing a refined one."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.addresses import Address, FilePlace
from amers.services.formats.images.raster import RasterImage, copy_with_rpc, open_raster
from amers.services.formats.sensor_models.dimap import format_dimap_rpc, parse_dimap_rpc
from amers.services.formats.sensor_models.geom import format_geom, is_geom, parse_geom
from amers.services.formats.sensor_models.rigorous_model import rpc_of_rigorous_model
from amers.services.formats.sensor_models.rpc_text import (
    RPC00A_ORDER,
    format_rpb,
    format_rpc_text,
    parse_rpb,
    parse_rpc_text,
    rpb_satellite,
    rpc_from_numbers,
)
from amers.services.formats.text_files import parse_number, read_text
from amers.services.sensors.rpc import RpcModel, check_rpc
from amers.services.statements import Statements

Convention = Literal["tags", "text", "rpb", "dimap", "geom", "rigorous"]

_Found = tuple[RpcModel, FilePlace, Convention, str]
"""A model, its file and format, and what was mended in it."""

_CROP_EVIDENCE = 2.0
"""How many times nearer to the first pixel the range of a model must start for an unambiguous choice."""


@dataclass(frozen=True)
class DeliveredModel:
    """The sensor model delivered with an image, in the pixels of that image.

    Attributes:
        model: checked by `check_rpc`; (0, 0) is the centre of the first pixel of the image.
        path: the file it was read from.
        convention: format of the model in that file.
        crop_origin: line and sample of the first pixel of the image in the image that the file models;
            subtracted from the image offsets of the file.
        note: one sentence: where the model was found, and why it was shifted or not.
        statements: of the files that were looked at.
    """

    model: RpcModel
    path: FilePlace
    convention: Convention
    crop_origin: tuple[float, float]
    note: str
    statements: Statements = ()


def read_rpc(
    path: FilePlace, model_path: Path | None = None, crop_origin: tuple[float, float] | None = None
) -> DeliveredModel:
    """The RPC of an image, in the pixels of that image.

    The RPC is, in this order: the file `model_path`; the RPC tags of a GeoTIFF or the RPC00B of a NITF;
    `STEM_RPC.TXT`, `STEM.RPB` or `STEM_RPC.XML` beside the image, for `IMG_NAME_R1C1` the `RPC_NAME.XML`
    of its DIMAP, or `STEM.geom` (in upper or lower case; spelt like that at an address).

    A crop often stores its position in the full scene as a geotransform of unit pixels without a
    reference system. Its RPC may then be for the full scene or for the crop. The range of the RPC,
    offset - scale to offset + scale, decides: it contains the image and starts near the first pixel of
    the image it is for. Where both are possible, `crop_origin` must be given. A position in which both
    numbers end in .5 counts from the centre of the first pixel, as OTB wrote it before 2014, and not
    from its corner: it stands for the whole pixel that follows.

    Args:
        path: of the image.
        model_path: `_RPC.TXT`, `.RPB`, DIMAP or `.geom` file of any name, or metadata with a rigorous
            model, to which an RPC is fitted; by default the one found.
        crop_origin: line and sample of the first pixel of the image in the image that the RPC is for;
            (0, 0) when the RPC is in the pixels of the image; by default decided as above.

    Raises:
        FormatError: there is no usable RPC; the message lists what was searched for.
    """
    image = open_raster(path)
    try:
        return model_of_image(image, model_path, crop_origin)
    finally:
        image.close()


def write_model(
    delivered: DeliveredModel | None, model: RpcModel, folder: Path, image_path: Path | None = None
) -> list[Path]:
    """Write a refined model as `refined_RPC.TXT` and in the format of the delivered model.

    Both are in the pixels of the image: the refined model of a crop is that of the crop, even where the
    delivered one is for the full scene. A file keeps its name. RPC tags become `STEM_RPC.TXT`, which
    GDAL prefers to the tags of the image beside it.

    Args:
        delivered: the delivered model; None for a model that is not an RPC, which is only written as
            `refined_RPC.TXT`, and so is one fitted to a rigorous model.
        model: the refined model.
        folder: where to write; created when missing.
        image_path: the image, when a copy with the refined model in its tags is to be written too.

    Returns:
        The files written.

    Raises:
        FormatError: a delivered file would be overwritten.
    """
    folder.mkdir(parents=True, exist_ok=True)
    texts = {"refined_RPC.TXT": format_rpc_text(model)}
    if delivered is not None:
        texts |= _in_delivered_format(delivered, model)
    written = []
    for name, text in texts.items():
        target = folder / name
        given = None if delivered is None else delivered.path
        if isinstance(given, Path) and target.resolve() == given.resolve():
            raise FormatError(
                f"{target}: the delivered model would be overwritten; give another output folder"
            )
        target.write_bytes(text.encode(_encoding(text)))
        written.append(target)
    if image_path is not None:
        copy_with_rpc(image_path, folder / image_path.name, model)
        written.append(folder / image_path.name)
    return written


def _in_delivered_format(delivered: DeliveredModel, model: RpcModel) -> dict[str, str]:
    """The text of the file that replaces the delivered one, by its name."""
    path = delivered.path
    if delivered.convention == "rigorous":
        return {}
    if delivered.convention == "rpb":
        return {path.name: format_rpb(model, rpb_satellite(read_text(path)))}
    if delivered.convention == "dimap":
        return {path.name: format_dimap_rpc(read_text(path), model, path.name)}
    if delivered.convention == "geom":
        return {path.name: format_geom(model, read_text(path))}
    name = f"{path.stem}_RPC.TXT" if delivered.convention == "tags" else path.name
    return {name: format_rpc_text(model)}


def model_of_image(
    image: RasterImage, model_path: FilePlace | None, crop_origin: tuple[float, float] | None
) -> DeliveredModel:
    """The RPC of an open image; see `read_rpc`."""
    if model_path is not None:
        model, path, convention, mended = _read_model_file(model_path)
    else:
        model, path, convention, mended = _find_model(image)
    check_rpc(model, path.name)
    offset = crop_offset(image)
    tile = re.search(r"_R(\d+)C(\d+)$", image.path.stem, re.IGNORECASE)
    if crop_origin is not None:
        origin, reason = crop_origin, "shifted as requested" if any(crop_origin) else "as requested"
    elif offset is not None:
        origin, reason = _choose_origin(model, offset, image)
    elif tile and convention in ("dimap", "rigorous") and (int(tile[1]), int(tile[2])) != (1, 1):
        raise FormatError(
            f"{image.path}: the image is a tile, and its RPC is for the whole image: give the position "
            "of its first pixel in the whole image as crop_origin=(line, sample)"
        )
    else:
        origin, reason = (0.0, 0.0), "in the pixels of the image"
    model = replace(model, image_offset=model.image_offset - np.array(origin))
    _check_coverage(model, image, path)
    note = ", ".join(part for part in (f"{convention} of {path.name}", mended, reason) if part)
    return DeliveredModel(model, path, convention, origin, note)


def has_rpc(image: RasterImage) -> bool:
    """Whether an image has RPC tags, or beside it a file with the name of its RPC."""
    return bool(image.dataset.tags(ns="RPC")) or bool(_files_beside(image)[1])


def _find_model(image: RasterImage) -> _Found:
    tags = image.dataset.tags(ns="RPC")
    if tags:
        records = image.dataset.tags(ns="TRE")
        if "RPC00A" in records and "RPC00B" not in records:
            tags = {**tags, **_rpc00a_coefficients(records["RPC00A"])}
        return _parse_tags(tags, image.path.name), image.path, "tags", ""
    names, files = _files_beside(image)
    if files:
        return _read_model_file(files[0])
    raise FormatError(
        f"{image.path}: no sensor model found: the file has neither a map grid nor RPC tags, and no "
        f"file {', '.join(names)} lies beside it; add one of these, or give the file of the model"
    )


def _files_beside(image: RasterImage) -> tuple[list[str], Sequence[FilePlace]]:
    """The names that the RPC of an image may have, and the files beside the image with such a name."""
    stem = image.path.stem
    names = [f"{stem}_RPC.TXT", f"{stem}.RPB", f"{stem}_RPC.XML"]
    airbus = re.fullmatch(r"IMG_(.+?)(_R\d+C\d+)?", stem, re.IGNORECASE)
    if airbus is not None:
        names.append(f"RPC_{airbus[1]}.XML")
    names.append(f"{stem}.geom")
    return names, files_named(image.path, names)


def files_named(path: FilePlace, names: Sequence[str]) -> list[FilePlace]:
    """The files beside an image that have one of these names, in upper or lower case, in their order."""
    if isinstance(path, Address):
        return [file for file in map(path.with_name, names) if file.is_file()]
    beside = {file.name.upper(): file for file in path.resolve().parent.iterdir()}
    return [beside[name.upper()] for name in names if name.upper() in beside]


def _read_model_file(path: FilePlace) -> _Found:
    """The RPC of a model file, whose content, not its name, decides on the format."""
    text = read_text(path)
    if text.lstrip("\ufeff \t\r\n").startswith("<"):
        fit = rpc_of_rigorous_model(text, path.name)
        if fit is not None:
            note = f"RPC fitted to it within {fit.max_error_px:.2g} px"
            return fit.model, path, "rigorous", note
        return parse_dimap_rpc(text, path.name), path, "dimap", ""
    if re.search(r"\bBEGIN_GROUP\b", text):
        return parse_rpb(text, path.name), path, "rpb", ""
    if is_geom(text):
        model, mended = parse_geom(text, path.name)
        return model, path, "geom", mended
    return parse_rpc_text(text, path.name), path, "text", ""


def _rpc00a_coefficients(record: str) -> dict[str, str]:
    """The coefficients of an RPC00A record in the order of RPC00B.

    Read from the record, because GDAL confuses four of the terms of the second degree.
    """
    starts = {"LINE_NUM": 81, "LINE_DEN": 321, "SAMP_NUM": 561, "SAMP_DEN": 801}
    return {
        f"{name}_COEFF": " ".join(record[start + 12 * i : start + 12 * (i + 1)] for i in RPC00A_ORDER)
        for name, start in starts.items()
    }


def _parse_tags(tags: dict[str, str], source: str) -> RpcModel:
    def number(key: str) -> float:
        name, _, index = key.partition("_COEFF_")
        if key in ("ERR_BIAS", "ERR_RAND"):
            return parse_number(tags.get(key, "-1"), key, source)
        values = tags.get(f"{name}_COEFF" if index else key, "").split()
        if len(values) != (20 if index else 1):
            raise FormatError(f"{source}: RPC tags: {key} is missing")
        return parse_number(values[int(index) - 1 if index else 0], key, source)

    return rpc_from_numbers(number)


def crop_offset(image: RasterImage) -> tuple[float, float] | None:
    """Line and sample of the first pixel in the full scene, when the geotransform marks a crop."""
    t = image.dataset.transform
    unit = (t.a, t.b, t.d, t.e) == (1.0, 0.0, 0.0, 1.0)
    if image.dataset.crs is not None or not unit:
        return None
    centred = t.c % 1.0 == 0.5 and t.f % 1.0 == 0.5
    offset = (t.f + 0.5, t.c + 0.5) if centred else (t.f, t.c)
    return None if offset == (0.0, 0.0) else offset


def _choose_origin(
    model: RpcModel, offset: tuple[float, float], image: RasterImage
) -> tuple[tuple[float, float], str]:
    """The crop origin of a model, `offset` for the full scene or (0, 0) for the crop, and the reason."""
    start = model.image_offset - model.image_scale
    end = model.image_offset + model.image_scale
    margin = 0.1 * model.image_scale
    last = np.array(image.shape) - 1.0
    contains, distance = [], []
    for origin in (np.zeros(2), np.array(offset)):
        contains.append(bool((origin >= start - margin).all() and (origin + last <= end + margin).all()))
        distance.append(float(np.hypot(*(start + np.array(offset) - origin))))
    crop, full = contains
    if crop and full:
        crop = distance[0] * _CROP_EVIDENCE < distance[1]
        full = distance[1] * _CROP_EVIDENCE < distance[0]
    where = f"line {offset[0]:g}, sample {offset[1]:g}"
    if crop and not full:
        return (0.0, 0.0), f"already in the pixels of the crop at {where}"
    if full and not crop:
        return offset, f"of the full scene, shifted to the crop at {where}"
    raise FormatError(
        f"{image.path}: a crop at {where}; its RPC, for lines {start[0]:g} to {end[0]:g} and samples "
        f"{start[1]:g} to {end[1]:g}, may be for the crop or for the full scene: give "
        f"crop_origin=(0, 0) or crop_origin=({offset[0]:g}, {offset[1]:g})"
    )


def _check_coverage(model: RpcModel, image: RasterImage, path: FilePlace) -> None:
    """Refuse a model that cannot locate the corners of the image."""
    lines, samples = image.shape
    corners = np.array([[0, 0], [0, samples - 1], [lines - 1, samples - 1], [lines - 1, 0]], float)
    height_m = np.full(4, sum(model.height_range_m) / 2.0)
    outside = int(np.isnan(model.locate(corners, height_m)[:, 0]).sum())
    if outside:
        raise FormatError(
            f"{path.name}: the RPC does not cover the image {image.path.name}: {outside} of its 4 "
            "corners are outside the ground range of the RPC"
        )


def _encoding(text: str) -> str:
    """The encoding of a text to write: UTF-8, or Latin-1 where an XML document declares it."""
    declared = re.match(r"\s*<\?xml[^>]*encoding=[\"']ISO-8859-1[\"']", text, re.IGNORECASE)
    return "latin-1" if declared else "utf-8"
