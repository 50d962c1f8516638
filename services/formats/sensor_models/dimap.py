"""DIMAP metadata: the RPC of SPOT 6/7, Pléiades (version 2) and Pléiades Neo (version 3).

Version 2 counts pixels from (1, 1), version 3 from (0, 0): GDAL's reader and files delivered both as
DIMAP and as GeoTIFF agree on it. Of the two models of a file only the one from the ground to the image
is read: `Inverse_Model` in version 2, `GroundtoImage_Values` in version 3. The errors it states are
those of the fit of the polynomials, not the accuracy of the scene, and are not read.
"""

import math
import re
from datetime import UTC, datetime
from xml.etree import ElementTree

import numpy as np

from services.errors import FormatError
from services.formats.sensor_models.rpc_text import parse_number, rpc_from_numbers
from services.sensors.rpc import RpcModel
from services.sensors.rpc_fit import fit_to_ground
from services.types import Acquisition, Array

_PROFILES = {"PHR": "PHR", "S6": "SPOT6", "S7": "SPOT7", "PNEO": "PNEO"}
_FOLD_TOLERANCE_PX = 1e-7
TO_GROUND_LIMIT_PX = 0.01
"""How far the two models of a document may be apart in the image."""

_TO_GROUND = {
    "Inverse_Model": ("Direct_Model", ("SAMP", "LINE")),
    "GroundtoImage_Values": ("ImagetoGround_Values", ("LON", "LAT")),
}
"""For the element of the model from the ground: that to the ground, and how it calls lon and lat."""


def parse_dimap_rpc(text: str, source: str = "DIMAP") -> RpcModel:
    """Read the RPC of a DIMAP document of version 2 or 3.

    In version 3 the first pixel is (0, 0), or (1, 1) when the validity domain says it starts there.

    Args:
        text: contents of the file.
        source: its name, for the messages.

    Raises:
        FormatError: when it is not such a document, or a number is missing or given twice.
    """
    root = _parse_xml(text, source)
    values, domain, first = _layout(root, source)
    model = _only(root, values, source)
    validity = _only(root, "RFM_Validity", source)

    def number(key: str) -> float:
        if key.startswith("ERR_"):
            return math.nan
        place = model if "COEFF" in key else validity
        return parse_number(_only(place, key, source).text or "", key, source)

    if domain is not None:
        starts = _only(root, domain, source)
        text_of = [_only(starts, name, source).text or "" for name in ("FIRST_ROW", "FIRST_COL")]
        first_row, first_col = (parse_number(t, domain, source) for t in text_of)
        first = (float(first_row == 1.0), float(first_col == 1.0))
    return rpc_from_numbers(number, first)


def format_dimap_rpc(text: str, model: RpcModel, source: str = "DIMAP") -> str:
    """A copy of a DIMAP document that carries another model.

    A model that differs from the document's own by a shift and a scale of each image coordinate (a
    crop, a shift, a drift) is written into the image offsets and scales, which the document's two models
    share: both stay true, and every coefficient stays as delivered. Any other model replaces the
    coefficients from the ground to the image, and those from the image to the ground are fitted anew to
    it; where no such fit comes within `TO_GROUND_LIMIT_PX` of it, the model to the ground, which would
    contradict it, is removed. Validity domains and the stated errors of the fits stay as delivered. The
    rest is copied to the letter.

    Args:
        text: the document the scene came with.
        model: in pixels from the centre of the first one, as everywhere.
        source: name of the document, for the messages.

    Raises:
        FormatError: when the document is not a DIMAP RPC, or would not read back as the model.
    """
    own = parse_dimap_rpc(text, source)
    root = _parse_xml(text, source)
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
        raise FormatError(f"{source}: the document could not take the model, {misfit_px:.3g} px apart")
    return written


def parse_dimap_acquisition(text: str, image_id: str, source: str = "DIMAP") -> Acquisition:
    """How an image was taken, as far as a DIMAP document says: the product's, or less from the RPC's.

    The sun is that of the image's centre. Incidence and azimuth are left to the model.

    Args:
        text: contents of the file.
        image_id: name of the image.
        source: name of the file, for the messages.

    Raises:
        FormatError: when it is not a DIMAP document.
    """
    root = _parse_xml(text, source)
    if root.tag != "Dimap_Document":
        raise FormatError(f"{source}: expected a DIMAP document, found <{root.tag[:60]}>")
    mission = root.findtext(".//Strip_Source/MISSION", "").strip()
    index = root.findtext(".//Strip_Source/MISSION_INDEX", "").strip()
    profile = root.findtext(".//METADATA_PROFILE", "").split("_")[0].strip()
    return Acquisition(
        image_id=image_id,
        sensor=mission + index or _PROFILES.get(profile, ""),
        acquired_at=parse_imaging_time(
            root.findtext(".//Strip_Source/IMAGING_DATE", ""),
            root.findtext(".//Strip_Source/IMAGING_TIME", ""),
        ),
        sun_elevation_deg=_centre_angle(root, "SUN_ELEVATION"),
        sun_azimuth_deg=_centre_angle(root, "SUN_AZIMUTH"),
    )


def parse_imaging_time(date: str, time: str) -> datetime | None:
    """UTC of an `IMAGING_DATE` and `IMAGING_TIME`; None when they do not say."""
    match = re.fullmatch(r"(\d\d:\d\d:\d\d)(?:\.(\d+))?Z?", time.strip())
    if match is None:
        return None
    try:
        return datetime.fromisoformat(f"{date.strip()}T{match[1]}.{(match[2] or '0')[:6]:0<6}").replace(
            tzinfo=UTC
        )
    except ValueError:
        return None


def _parse_xml(text: str, source: str) -> ElementTree.Element:
    """The root of a document; document types are refused, and with them entities of any kind."""
    if "<!DOCTYPE" in text:
        raise FormatError(f"{source}: documents with a document type are not read")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise FormatError(f"{source}: not a well-formed XML document: {error}") from None


def _layout(root: ElementTree.Element, source: str) -> tuple[str, str | None, tuple[float, float]]:
    """Element of the model, element of the domain that tells the first pixel, first pixel otherwise."""
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


def _only(place: ElementTree.Element, name: str, source: str) -> ElementTree.Element:
    found = place.findall(f".//{name}")
    if len(found) != 1:
        raise FormatError(f"{source}: expected one {name} in <{place.tag}>, found {len(found)}")
    return found[0]


def _file_offset(root: ElementTree.Element, source: str) -> Array:
    return np.array(
        [
            parse_number(_only(root, key, source).text or "", key, source)
            for key in ("LINE_OFF", "SAMP_OFF")
        ]
    )


def _image_frame(own: RpcModel, model: RpcModel) -> tuple[Array, Array] | None:
    """Image offset and scale that turn one model into another, None when no such pair does.

    Fitted on a grid of ground points: what has to hold there is `image' = gain image + constant`.
    """
    axis = np.linspace(-1.0, 1.0, 7)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    ground = own.ground_offset + grid * own.ground_scale
    before, after = own.project(ground), model.project(ground)
    seen = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    if not seen.any():
        return None
    offset, scale = np.empty(2), np.empty(2)
    for k in range(2):
        normalised = (before[seen, k] - own.image_offset[k]) / own.image_scale[k]
        design = np.column_stack([np.ones(len(normalised)), normalised])
        solution = np.linalg.lstsq(design, after[seen, k], rcond=None)[0]
        if not np.abs(design @ solution - after[seen, k]).max() < _FOLD_TOLERANCE_PX:
            return None
        offset[k], scale[k] = solution
    return (offset, scale) if (scale > 0).all() else None


def _with_coefficients(text: str, values: str, model: RpcModel) -> str:
    """The document with a new model from the ground, and one to the ground that agrees with it."""
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
    """The document with other coefficients in one of its elements."""
    head, body, tail = _split(text, element)
    for name, coefficients in polynomials.items():
        for i, value in enumerate(coefficients.tolist(), start=1):
            body = _with_number(body, f"{name}_COEFF_{i}", value)
    return head + body + tail


def _split(text: str, element: str) -> tuple[str, str, str]:
    start, end = text.find(f"<{element}"), text.find(f"</{element}>")
    return text[:start], text[start:end], text[end:]


def _with_number(text: str, element: str, value: float) -> str:
    return re.sub(rf"(<{element}\b[^>]*>)[^<]*(</{element}>)", rf"\g<1>{value!r}\g<2>", text, count=1)


def _misfit_px(a: RpcModel, b: RpcModel) -> float:
    axis = np.linspace(-1.0, 1.0, 5)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    ground = b.ground_offset + grid * b.ground_scale
    return float(np.abs(a.project(ground) - b.project(ground)).max())


def _centre_angle(root: ElementTree.Element, name: str) -> float:
    """An angle of the located values of the centre; NaN when there is none."""
    for place in root.iter("Located_Geometric_Values"):
        if place.findtext("LOCATION_TYPE", "").strip().lower() == "center":
            try:
                return parse_number(place.findtext(f".//{name}", ""), name, "")
            except FormatError:
                return math.nan
    return math.nan
