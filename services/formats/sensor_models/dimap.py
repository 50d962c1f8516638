"""DIMAP metadata: the RPC of SPOT 6/7, Pléiades (version 2) and Pléiades Neo (version 3).

Version 2 counts pixels from (1, 1), version 3 from (0, 0). GDAL's reader, and images delivered both as
DIMAP and as GeoTIFF, confirm it. A document has two models; only the one from the ground to the image
is read: `Inverse_Model` in version 2, `GroundtoImage_Values` in version 3. The errors in the document
are those of the fit of the polynomials, not the accuracy of the scene, and are not read.
"""

import math
import re
from datetime import UTC, datetime
from xml.etree import ElementTree

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.images.bands import PixelCodes
from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.formats.sensor_models.rpc_text import rpc_from_numbers
from amers.services.formats.sensor_models.xml_values import elements_by_tag, single
from amers.services.formats.text_files import parse_number, parse_xml
from amers.services.sensors.rpc import RpcModel
from amers.services.sensors.rpc_fit import fit_to_ground
from amers.services.statements import Subject
from amers.services.types import Acquisition, Array

READER = Reader(
    "RPC of DIMAP (`RPC_….XML`, with `DIM_….XML`)",
    ("parse_dimap_rpc", "parse_dimap_acquisition", "parse_dimap_pixel_codes"),
    (
        Treatment(
            Subject.MODEL,
            "used",
            "Inverse_Model in version 2, or GroundtoImage_Values in version 3, states the RPC.",
        ),
        Treatment(Subject.MODEL, "refused", "The document has another version, or a number is missing."),
        Treatment(
            Subject.PIXEL_ORIGIN,
            "used",
            "The first pixel is (1, 1) in version 2. In version 3, the domain of the model states it.",
        ),
        Treatment(
            Subject.PLACE,
            "used",
            "`DIM_….XML` lists the position of each tile. A part such as `_R2C1` of the "
            "file name identifies the tile.",
        ),
        Treatment(
            Subject.PLACE,
            "refused",
            "The image is a tile and has no `DIM_….XML`, or the tile has another size "
            "than this document states.",
        ),
        Treatment(
            Subject.PLACE,
            "assumed",
            "The image has another size than the domain of the model: Amers assumes that "
            "both begin at the same first pixel.",
        ),
        Treatment(
            Subject.VALIDITY, "used", "`DIM_….XML` states the special values NODATA and SATURATED."
        ),
        Treatment(
            Subject.ACCURACY,
            "named",
            "The file states errors of the fit of the polynomials. These are not the "
            "accuracy of the scene.",
        ),
        Treatment(
            Subject.ACCURACY,
            "assumed",
            "The file states no accuracy of the scene: Amers uses the accuracy of the sensor.",
        ),
        Treatment(Subject.IDENTITY, "used", "`DIM_….XML` states mission, time and sun angles."),
    ),
    never=(
        Subject.HORIZONTAL_DATUM,
        Subject.VERTICAL_DATUM,
        Subject.UNIT,
        Subject.EPOCH,
        Subject.ORDER,
        Subject.BANDS,
    ),
)

_PROFILES = {"PHR": "PHR", "S6": "SPOT6", "S7": "SPOT7", "PNEO": "PNEO"}
_FOLD_TOLERANCE_PX = 1e-7
TO_GROUND_LIMIT_PX = 0.01
"""Largest distance in the image between the two models of a document."""

_TO_GROUND = {
    "Inverse_Model": ("Direct_Model", ("SAMP", "LINE")),
    "GroundtoImage_Values": ("ImagetoGround_Values", ("LON", "LAT")),
}
"""By element of the model from the ground: element of the model to the ground, and its prefixes."""


def parse_dimap_rpc(text: str, source: str = "DIMAP") -> RpcModel:
    """The RPC of a DIMAP document of version 2 or 3.

    In version 3 the first pixel is (0, 0), or (1, 1) when the validity domain starts there.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: it is not such a document, or a number is missing or given twice.
    """
    root = parse_xml(text, source)
    model = elements_by_tag(single(root, _layout(root, source)[0], source))
    validity = elements_by_tag(single(root, "RFM_Validity", source))

    def number(key: str) -> float:
        if key.startswith("ERR_"):
            return math.nan
        found = (model if "COEFF" in key else validity).get(key, [])
        if len(found) != 1:
            raise FormatError(f"{source}: expected one {key} in the model, found {len(found)}")
        return parse_number(found[0].text or "", key, source)

    return rpc_from_numbers(number, dimap_first_pixel(root, source))


def dimap_first_pixel(root: ElementTree.Element, source: str) -> tuple[float, float]:
    """Line and sample of the first pixel in the convention of a DIMAP document.

    Raises:
        FormatError: it is not a document of version 2 or 3, or its validity domain has no number.
    """
    _, domain, first = _layout(root, source)
    if domain is not None:
        first_texts = [
            single(single(root, domain, source), name, source).text or ""
            for name in ("FIRST_ROW", "FIRST_COL")
        ]
        first_row, first_col = (parse_number(text, domain, source) for text in first_texts)
        first = (float(first_row == 1.0), float(first_col == 1.0))
    return first


def format_dimap_rpc(text: str, model: RpcModel, source: str = "DIMAP") -> str:
    """A copy of a DIMAP document with another RPC.

    A model that differs from that of the document by a shift and a scale of each image coordinate (a
    crop, a shift, a drift) goes into the image offsets and scales, which both models of the document
    share: both remain valid and all coefficients unchanged. Any other model replaces the coefficients
    from the ground to the image, and the coefficients from the image to the ground are fitted to it;
    where this fit is not within `TO_GROUND_LIMIT_PX`, the model to the ground is removed, because it
    would contradict the new one. Validity domains and stated errors of the fits remain unchanged, and so
    does every other character.

    Args:
        text: the delivered document.
        model: the RPC to write.
        source: name of the document, for messages.

    Raises:
        FormatError: the document is not a DIMAP RPC, or does not read back as the model.
    """
    own = parse_dimap_rpc(text, source)
    root = parse_xml(text, source)
    values = _layout(root, source)[0]
    first = _file_offset(root, source) - own.image_offset
    folded = _image_frame(own, model)
    if folded is None:
        written = _with_coefficients(text, values, model)
        offset, scale = model.image_offset, model.image_scale
    else:
        written, (offset, scale) = text, folded
    frame = np.concatenate([offset + first, scale])
    for key, value in zip(("LINE_OFF", "SAMP_OFF", "LINE_SCALE", "SAMP_SCALE"), frame, strict=True):
        written = _with_number(written, key, float(value))
    if folded is None:
        for key, value in zip(
            ("LONG_OFF", "LAT_OFF", "HEIGHT_OFF", "LONG_SCALE", "LAT_SCALE", "HEIGHT_SCALE"),
            np.concatenate([model.ground_offset, model.ground_scale]),
            strict=True,
        ):
            written = _with_number(written, key, float(value))
    misfit_px = _misfit_px(parse_dimap_rpc(written, source), model)
    if not misfit_px < 1e-6:
        raise FormatError(
            f"{source}: the model written to the document differs by {misfit_px:.3g} px when read back, "
            "less than 1e-6 px expected"
        )
    return written


def parse_dimap_acquisition(text: str, image_id: str, source: str = "DIMAP") -> Acquisition:
    """Sensor, time and sun of an image from the DIMAP document of its product, or of its RPC.

    The source of an image is a strip; in DIMAP 1, of SPOT 1 to 5, it is a scene. The document of the RPC
    has the sensor only. The sun angles are those of the image centre. Incidence and azimuth stay
    unknown; they follow from the model.

    Args:
        text: contents of the file.
        image_id: name of the image.
        source: name of the file, for messages.

    Raises:
        FormatError: it is not a DIMAP document.
    """
    root = parse_xml(text, source)
    if root.tag != "Dimap_Document":
        raise FormatError(f"{source}: expected a DIMAP document, found <{root.tag[:60]}>")
    source_of = ".//Strip_Source" if root.find(".//Strip_Source") is not None else ".//Scene_Source"
    mission = root.findtext(f"{source_of}/MISSION", "").strip()
    index = root.findtext(f"{source_of}/MISSION_INDEX", "").strip()
    profile = root.findtext(".//METADATA_PROFILE", "").split("_")[0].strip()
    return Acquisition(
        image_id=image_id,
        sensor=mission + index or _PROFILES.get(profile, ""),
        acquired_at=parse_imaging_time(
            root.findtext(f"{source_of}/IMAGING_DATE", ""),
            root.findtext(f"{source_of}/IMAGING_TIME", ""),
        ),
        sun_elevation_deg=_centre_angle(root, "SUN_ELEVATION"),
        sun_azimuth_deg=_centre_angle(root, "SUN_AZIMUTH"),
    )


def parse_dimap_pixel_codes(text: str, source: str = "DIMAP") -> PixelCodes:
    """Statements of the document of a product about its pixels; the document of its RPC has none.

    Args:
        text: contents of the file.
        source: name of the file, for messages.

    Raises:
        FormatError: it is not an XML document.
    """
    values = {
        special.findtext("SPECIAL_VALUE_TEXT", "").strip(): special.findtext("SPECIAL_VALUE_COUNT", "")
        for special in parse_xml(text, source).iter("Special_Value")
    }

    def code(name: str) -> int | None:
        digits = re.fullmatch(r"\s*(\d{1,5})\s*", values.get(name, ""))
        return None if digits is None else int(digits[1])

    return PixelCodes(code("NODATA"), code("SATURATED"))


def parse_imaging_time(date: str, time: str) -> datetime | None:
    """The UTC time of an `IMAGING_DATE` and an `IMAGING_TIME`; None when they are not a time."""
    match = re.fullmatch(r"(\d\d:\d\d:\d\d)(?:\.(\d+))?Z?", time.strip())
    if match is None:
        return None
    try:
        return datetime.fromisoformat(f"{date.strip()}T{match[1]}.{(match[2] or '0')[:6]:0<6}").replace(
            tzinfo=UTC
        )
    except ValueError:
        return None


def _layout(root: ElementTree.Element, source: str) -> tuple[str, str | None, tuple[float, float]]:
    """Element of the model, element of the domain with the first pixel if any, default first pixel."""
    declared = root.find("Metadata_Identification/METADATA_FORMAT")
    version = "" if declared is None else declared.get("version", "")
    if root.tag == "Dimap_Document" and version.startswith("2."):
        return "Inverse_Model", None, (1.0, 1.0)
    if root.tag == "Dimap_Document" and version.startswith("3."):
        return "GroundtoImage_Values", "ImagetoGround_Validity_Domain", (0.0, 0.0)
    raise FormatError(
        f"{source}: expected a DIMAP document of version 2 or 3, "
        f"found <{root.tag[:60]}> of version {version[:20] or 'unknown'}"
    )


def _file_offset(root: ElementTree.Element, source: str) -> Array:
    """The image offset (2,) as the document has it, with its own first pixel."""
    return np.array(
        [
            parse_number(single(root, key, source).text or "", key, source)
            for key in ("LINE_OFF", "SAMP_OFF")
        ]
    )


def _image_frame(own: RpcModel, model: RpcModel) -> tuple[Array, Array] | None:
    """Image offset and scale that turn one model into another; None when there is no such pair.

    Fitted on a grid of ground points by `image' = gain image + constant`.
    """
    axis = np.linspace(-1.0, 1.0, 7)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    ground = own.ground_offset + grid * own.ground_scale
    before, after = own.project(ground), model.project(ground)
    valid = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    if not valid.any():
        return None
    offset, scale = np.empty(2), np.empty(2)
    for k in range(2):
        normalised = (before[valid, k] - own.image_offset[k]) / own.image_scale[k]
        design = np.column_stack([np.ones(len(normalised)), normalised])
        solution = np.linalg.lstsq(design, after[valid, k], rcond=None)[0]
        if not np.abs(design @ solution - after[valid, k]).max() < _FOLD_TOLERANCE_PX:
            return None
        offset[k], scale[k] = solution
    return (offset, scale) if (scale > 0).all() else None


def _with_coefficients(text: str, values: str, model: RpcModel) -> str:
    """The document with the coefficients of a new model from the ground, and its inverse fit."""
    polynomials = {
        "LINE_NUM": model.line_num,
        "LINE_DEN": model.line_den,
        "SAMP_NUM": model.sample_num,
        "SAMP_DEN": model.sample_den,
    }
    text = _with_polynomials(text, values, polynomials)
    to_ground, (lon, lat) = _TO_GROUND[values]
    fit = fit_to_ground(model)
    if not fit.max_error_px < TO_GROUND_LIMIT_PX:
        return re.sub(rf"[ \t]*<{to_ground}\b.*?</{to_ground}>\s*?\n?", "", text, flags=re.DOTALL)
    polynomials = {
        f"{lon}_NUM": fit.lon_num,
        f"{lon}_DEN": fit.lon_den,
        f"{lat}_NUM": fit.lat_num,
        f"{lat}_DEN": fit.lat_den,
    }
    return _with_polynomials(text, to_ground, polynomials)


def _with_polynomials(text: str, element: str, polynomials: dict[str, Array]) -> str:
    """The document with new coefficients in one of its elements."""
    head, body, tail = _split_at(text, element)
    for name, coefficients in polynomials.items():
        for i, value in enumerate(coefficients.tolist(), start=1):
            body = _with_number(body, f"{name}_COEFF_{i}", value)
    return head + body + tail


def _split_at(text: str, element: str) -> tuple[str, str, str]:
    start, end = text.find(f"<{element}"), text.find(f"</{element}>")
    return text[:start], text[start:end], text[end:]


def _with_number(text: str, element: str, value: float) -> str:
    return re.sub(rf"(<{element}\b[^>]*>)[^<]*(</{element}>)", rf"\g<1>{value!r}\g<2>", text, count=1)


def _misfit_px(a: RpcModel, b: RpcModel) -> float:
    """Largest difference in the image between two models over the range of the second."""
    axis = np.linspace(-1.0, 1.0, 5)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    ground = b.ground_offset + grid * b.ground_scale
    return float(np.abs(a.project(ground) - b.project(ground)).max())


def _centre_angle(root: ElementTree.Element, name: str) -> float:
    """An angle of the values located at the image centre; NaN without such values."""
    for values in root.iter("Located_Geometric_Values"):
        if values.findtext("LOCATION_TYPE", "").strip().lower() == "center":
            try:
                return parse_number(values.findtext(f".//{name}", ""), name, "")
            except FormatError:
                return math.nan
    return math.nan
