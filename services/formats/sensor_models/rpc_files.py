"""The RPC of an image: finding it, converting it to the pixels of the image, writing a refined one."""

import re
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.images.georeference import georeference
from amers.services.formats.images.raster import RasterImage, copy_with_rpc
from amers.services.formats.images.siblings import Siblings
from amers.services.formats.images.tiled_image import SceneImage, TiledImage
from amers.services.formats.sensor_models.dimap import format_dimap_rpc
from amers.services.formats.sensor_models.geom import format_geom
from amers.services.formats.sensor_models.model_files import (
    Convention,
    FoundModel,
    format_aux_rpc,
    read_model_file,
)
from amers.services.formats.sensor_models.model_order import (
    ModelSource,
    model_sources,
    model_statements,
    names_of_models,
    other_model,
)
from amers.services.formats.sensor_models.place import Place, stated_place
from amers.services.formats.sensor_models.product_documents import without_tile
from amers.services.formats.sensor_models.product_image import open_image
from amers.services.formats.sensor_models.rpc_text import format_rpb, format_rpc_text, rpb_satellite
from amers.services.formats.text_files import read_text
from amers.services.sensors.rpc import RpcModel, check_rpc
from amers.services.statements import Statement, Statements, Subject, Use

MODEL_SUFFIXES = (".txt", ".xml", ".rpb", ".rpc", ".geom", ".dim")
_CROP_EVIDENCE = 2.0
"""How many times nearer to the first pixel the range of a model must start for an unambiguous choice."""


@dataclass(frozen=True)
class DeliveredModel:
    """The sensor model delivered with an image, in the pixels of that image.

    Attributes:
        model: checked by `check_rpc`; (0, 0) is the centre of the first pixel of the image.
        found: the same as its file has it.
        crop_origin: line and sample of the first pixel of the image in the image that the file models;
            subtracted from the image offsets of the file.
        note: one sentence: where the model was found, and why it was shifted or not.
        statements: of the files that were looked at.
        place: of the image in the image that the file models; None where that is the image itself.
    """

    model: RpcModel
    found: FoundModel
    crop_origin: tuple[float, float]
    note: str
    statements: Statements = ()
    place: Place | None = None

    @property
    def path(self) -> FilePlace:
        """The file it was read from."""
        return self.found.path

    @property
    def convention(self) -> Convention:
        """Format of the model in that file."""
        return self.found.convention


class ImageFiles(NamedTuple):
    """What the model of an image is read from.

    Attributes:
        image: the image, or as for `open_image`.
        model: file of its model; None finds it.
        crop_origin: line and sample of its first pixel in the image that the model is for; None where
            its files state it.
    """

    image: Path
    model: Path | None = None
    crop_origin: tuple[float, float] | None = None


def read_rpc(
    path: FilePlace, model_path: Path | None = None, crop_origin: tuple[float, float] | None = None
) -> DeliveredModel:
    """The RPC of an image, in the pixels of that image.

    The RPC is the file `model_path`, else the first one in the order of GDAL (`model_order`): a model in
    the tags of the image, or beside it in a file with the name that its producer gives it, in upper or
    lower case (spelt like that at an address). Where an image has several, the record of statements
    says which is used, and by how many pixels the others differ.

    The RPC of a product in tiles, and that of a NITF with ICHIPB, is for the full image: the document of
    the product or the record state where the image is in it.

    A crop often stores its position in the full scene as a geotransform without a reference system, of
    unit pixels, or of larger ones where it is reduced. Its RPC may then be for the full scene or for the
    crop. The range of the RPC, offset - scale to offset + scale, decides: it contains the image and
    starts near the first pixel of the image it is for. Where both are possible, `crop_origin` must be
    given. A position in which both
    numbers end in .5 counts from the centre of the first pixel, as OTB wrote it before 2014, and not
    from its corner: it stands for the whole pixel that follows.

    Args:
        path: of the image, or as for `open_image`.
        model_path: `_RPC.TXT`, `.RPB`, DIMAP or `.geom` file of any name, or metadata with a rigorous
            model, to which an RPC is fitted; by default the one found.
        crop_origin: line and sample of the first pixel of the image in the image that the RPC is for;
            (0, 0) when the RPC is in the pixels of the image; by default decided as above.

    Raises:
        FormatError: there is no usable RPC; the message lists what was searched for.
    """
    image = open_image(path)
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
    """The text of the file that replaces the delivered one, by its name.

    It is in the pixels of the delivered file where the place of the image is stated for its format: it
    is then read like the delivered one.
    """
    path, place = delivered.path, delivered.place
    if place is not None and delivered.convention in place.decides_for - {"tags"}:
        first, step = np.array(place.first), np.array(place.step)
        model = replace(
            model, image_offset=first + step * model.image_offset, image_scale=step * model.image_scale
        )
    if delivered.convention == "rigorous":
        return {}
    if delivered.convention == "rpb":
        return {path.name: format_rpb(model, rpb_satellite(read_text(path)))}
    if delivered.convention == "isd":
        return {f"{path.stem}.RPB": format_rpb(model)}
    if delivered.convention == "dimap":
        return {path.name: format_dimap_rpc(read_text(path), model, path.name)}
    if delivered.convention == "geom":
        return {path.name: format_geom(model, read_text(path))}
    if delivered.convention == "aux":
        return {path.name: format_aux_rpc(read_text(path), model)}
    name = f"{path.stem}_RPC.TXT" if delivered.convention == "tags" else path.name
    return {name: format_rpc_text(model)}


def model_of_image(
    image: SceneImage,
    model_path: FilePlace | None,
    crop_origin: tuple[float, float] | None,
    siblings: Siblings | None = None,
) -> DeliveredModel:
    """The RPC of an open image; see `read_rpc`."""
    siblings = siblings or Siblings(image.path)
    if model_path is not None:
        return _delivered(read_model_file(model_path), image, siblings, crop_origin, given=model_path)
    sources = list(model_sources(image, siblings))
    if not sources:
        raise FormatError(_no_model(image, siblings))
    others = sources[1:]
    used = _delivered(sources[0].read(), image, siblings, crop_origin)
    if not others:
        return used

    def place(source: ModelSource) -> RpcModel:
        return _delivered(source.read(), image, siblings, crop_origin).model

    compared = [
        (
            f"tags of {source.path.name}" if source.kind == "tags" else source.path.name,
            other_model(partial(place, source)),
        )
        for source in others
    ]
    statements = model_statements(used.found, used.model, compared, image.shape)
    return replace(used, statements=(*statements, *used.statements[1:]))


def has_rpc(image: SceneImage, siblings: Siblings | None = None) -> bool:
    """Whether an image has an RPC in its tags, or beside it in a file with the name of its model."""
    sources = model_sources(image, siblings or Siblings(image.path))
    return any(source.kind != "rigorous" for source in sources)


def _delivered(
    found: FoundModel,
    image: SceneImage,
    siblings: Siblings,
    crop_origin: tuple[float, float] | None,
    given: FilePlace | None = None,
) -> DeliveredModel:
    """A model in the pixels of its image."""
    check_rpc(found.model, found.path.name)
    place, reason, stated = _place_of(found, image, siblings, crop_origin, given)
    model = found.model
    if place is not None:
        first, step = np.array(place.first), np.array(place.step)
        model = replace(
            model,
            image_offset=(model.image_offset - first) / step,
            image_scale=model.image_scale / step,
        )
    _check_coverage(model, image, found.path)
    note = ", ".join(
        part for part in (f"{found.convention} of {found.path.name}", found.mended, reason) if part
    )
    used = model_statements(found, model, [], image.shape)
    origin = (0.0, 0.0) if place is None else place.first
    statements = (*used, *found.statements, *stated)
    return DeliveredModel(model, found, origin, note, statements, place)


def _place_of(
    found: FoundModel,
    image: SceneImage,
    siblings: Siblings,
    crop_origin: tuple[float, float] | None,
    given: FilePlace | None,
) -> tuple[Place | None, str, list[Statement]]:
    """The place of an image in the image that a model is for, the reason, and what became of statements.

    No place means that the model is in the pixels of the image.
    """
    if crop_origin is not None and not any(crop_origin):
        return None, "as requested", []
    if isinstance(image, TiledImage):
        return None, "in the pixels of the whole image", []
    stated = stated_place(image, siblings, given)
    if crop_origin is not None:
        step = (1.0, 1.0) if stated is None else stated.step
        return Place(crop_origin, step, "", "as requested"), "shifted as requested", []
    if stated is None:
        return None, "in the pixels of the image", _without_place(found, image)
    shifts, reason = True, f"of the full image, {stated.what} at {stated}"
    if found.convention not in stated.decides_for:
        shifts, reason = _is_of_full_image(found.model, stated, image)
    use = Use.USED if shifts else Use.NOT_USED
    note = "" if shifts else f"{found.name} is in the pixels of this image"
    statement = Statement(stated.file, Subject.PLACE, use, str(stated), where=stated.what, note=note)
    return stated if shifts else None, reason, [statement]


def _without_place(found: FoundModel, image: RasterImage) -> list[Statement]:
    """What is assumed, named or refused of an image whose place nothing states."""
    magnification = image.dataset.tags().get("NITF_IMAG", "1.0").strip()
    if magnification not in ("1.0", "1", "1.00", ""):
        note = f"{found.name} is taken to be for these pixels, no ICHIPB states otherwise"
        value = f"IMAG {magnification}"
        return [Statement(image.path.name, Subject.PLACE, Use.NOT_USED, value, note=note)]
    tile = without_tile(image.path.stem) != image.path.stem and "_R1C1" not in image.path.stem.upper()
    if not tile:
        if found.shape in (None, image.shape):
            return []
        size = f"{found.shape[0]} x {found.shape[1]}" if found.shape else ""
        note = (
            f"{found.name} is for {size} pixels, the image has {image.shape[0]} x {image.shape[1]}: "
            "taken from the first pixel on; --crop-origin LINE,SAMPLE states another place"
        )
        value = "line 0, sample 0"
        return [Statement(image.path.name, Subject.PLACE, Use.ASSUMED, value, note=note)]
    name = image.path.name
    of_whole = found.convention in ("dimap", "rigorous") or (
        found.convention in ("rpb", "isd") and without_tile(found.path.stem) == found.path.stem
    )
    if of_whole:
        raise FormatError(
            f"{image.path}: the image is a tile, and its RPC is for the whole image, {found.path.name}: "
            "put the document of the product (DIM_….XML or .TIL) beside it, or give the position of its "
            "first pixel in the whole image (--crop-origin LINE,SAMPLE; crop_origin=(line, sample))"
        )
    return [
        Statement(
            name,
            Subject.PLACE,
            Use.ASSUMED,
            "line 0, sample 0",
            note=f"its name says that it is a tile; {found.name} is taken to be for the tile alone, no "
            ".TIL or DIM_….XML beside it states otherwise; --crop-origin LINE,SAMPLE does",
        )
    ]


def _no_model(image: SceneImage, siblings: Siblings) -> str:
    """Why an image has no model, and what mends it."""
    names = list(dict.fromkeys(name for kind in names_of_models(image).values() for name in kind))
    message = (
        f"{image.path}: no sensor model found: the file has neither a map grid nor RPC tags, and no "
        f"file {', '.join(names)} lies beside it; add one of these, or give the file of the model "
        "(--model)"
    )
    map_grid = georeference(image.path, image.dataset)
    if not map_grid.transform.is_identity and map_grid.statements:
        message += (
            f"; {map_grid.statements[0].file} has a geotransform and no reference system: add "
            f"{image.path.stem}.prj with it as WKT"
        )
    if image.dataset.gcps[0]:
        message += (
            f"; it has {len(image.dataset.gcps[0])} ground control points, to which no model is fitted: "
            "give its RPC, or warp it to a map first (gdalwarp -tps -t_srs EPSG:…)"
        )
    others = [
        file.name
        for suffix in MODEL_SUFFIXES
        for file in siblings.ending(suffix)
        if file.name.upper() not in map(str.upper, names) and _is_model(file)
    ]
    if others:
        message += f"; {', '.join(others[:5])} beside it has a model: --model takes it"
    return message


def _is_model(file: FilePlace) -> bool:
    try:
        check_rpc(read_model_file(file).model, file.name)
    except FormatError:
        return False
    return True


def _is_of_full_image(model: RpcModel, place: Place, image: RasterImage) -> tuple[bool, str]:
    """Whether a model is of the full image in which an image has a place, and the reason.

    Its range, offset - scale to offset + scale, contains the image, and starts near the first pixel of
    the full image, once it is in the pixels that it is for.
    """
    first, step = np.array(place.first), np.array(place.step)
    start = model.image_offset - model.image_scale
    end = model.image_offset + model.image_scale
    margin = 0.1 * model.image_scale
    last = np.array(image.shape) - 1.0
    contains, distance = [], []
    for origin, scale in ((np.zeros(2), np.ones(2)), (first, step)):
        inside = (origin >= start - margin).all() and (origin + scale * last <= end + margin).all()
        contains.append(bool(inside))
        distance.append(float(np.hypot(*(first + step * (start - origin) / scale))))
    own, full = contains
    if own and full:
        own = distance[0] * _CROP_EVIDENCE < distance[1]
        full = distance[1] * _CROP_EVIDENCE < distance[0]
    if full and not own:
        return True, f"of the full scene, shifted to the crop at {place}"
    if place.is_certain or (own and not full):
        return False, f"already in the pixels of the crop at {place}"
    kind = "a crop" if place.step == (1.0, 1.0) else "a reduced crop"
    raise FormatError(
        f"{image.path}: {kind} at {place}; its RPC, for lines {start[0]:g} to {end[0]:g} and samples "
        f"{start[1]:g} to {end[1]:g}, may be for the crop or for the full scene: give "
        f"crop_origin=(0, 0) or crop_origin=({place.first[0]:g}, {place.first[1]:g}) "
        f"(--crop-origin 0,0 or --crop-origin {place.first[0]:g},{place.first[1]:g})"
    )


def _check_coverage(model: RpcModel, image: SceneImage, path: FilePlace) -> None:
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
