"""OSSIM keyword lists with an RPC (`.geom`), as written by OTB, CARS and shareloc.

Pixels count from the centre of the first pixel at (0, 0); heights are above the ellipsoid. Coefficients
are numbered from 00. Sources: `ossimRpcModel` (format, adjustments); the loaders of Pléiades and SPOT 6
in ossim-plugins (lost halves of pixels), compared with DIMAP files of the same products.
"""

import math
import re
from collections.abc import Mapping

from amers.services.errors import FormatError
from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.formats.sensor_models.dimap import parse_imaging_time
from amers.services.formats.sensor_models.rpc_text import (
    RPC00A_ORDER,
    Numbers,
    named_numbers,
    rpc_from_numbers,
)
from amers.services.formats.text_files import parse_number
from amers.services.sensors.rpc import RpcModel
from amers.services.statements import Subject
from amers.services.types import Acquisition

READER = Reader(
    "OSSIM and OTB `.geom`",
    ("parse_geom", "parse_geom_acquisition"),
    (
        Treatment(
            Subject.MODEL,
            "used",
            "The file contains an RPC. Amers applies the current adjustment of the file to it.",
        ),
        Treatment(
            Subject.MODEL,
            "refused",
            "The file has no RPC, or it has an adjustment that an RPC cannot express.",
        ),
        Treatment(
            Subject.PIXEL_ORIGIN,
            "used",
            "The file comes from one of two OSSIM loaders that lose half a pixel. Amers "
            "corrects this half pixel.",
        ),
        Treatment(Subject.ORDER, "refused", "polynomial_format is neither A nor B."),
        Treatment(
            Subject.PLACE,
            "used",
            "An image that OTB cropped has a geotransform. The range of the RPC decides "
            "whether the RPC belongs to the full image.",
        ),
        Treatment(Subject.ACCURACY, "used", "bias_error and rand_error are positive numbers."),
        Treatment(
            Subject.IDENTITY, "used", "sensor, image_date and the sun angles describe the acquisition."
        ),
    ),
    never=(
        Subject.HORIZONTAL_DATUM,
        Subject.VERTICAL_DATUM,
        Subject.UNIT,
        Subject.EPOCH,
        Subject.VALIDITY,
        Subject.BANDS,
    ),
)

_KEYS = {
    "ERR_BIAS": "bias_error",
    "ERR_RAND": "rand_error",
    "LINE_OFF": "line_off",
    "SAMP_OFF": "samp_off",
    "LAT_OFF": "lat_off",
    "LONG_OFF": "long_off",
    "HEIGHT_OFF": "height_off",
    "LINE_SCALE": "line_scale",
    "SAMP_SCALE": "samp_scale",
    "LAT_SCALE": "lat_scale",
    "LONG_SCALE": "long_scale",
    "HEIGHT_SCALE": "height_scale",
}
_ADJUSTED = {
    "intrack_offset": "LINE_OFF",
    "crtrack_offset": "SAMP_OFF",
    "intrack_scale": "LINE_SCALE",
    "crtrack_scale": "SAMP_SCALE",
}
"""Adjustable parameters of `ossimRpcModel` and the number of the RPC that each is added to, pixels."""

_SENSORS = {"GeoEye-1": "GE01"}
"""Sensors that OSSIM names otherwise than their producer's RPC files."""


def is_geom(text: str) -> bool:
    """Whether a text is an OSSIM keyword list of a sensor model."""
    return (
        re.search(r"^(?:polynomial_format|line_num_coeff_00|type)\s*:", text, re.MULTILINE) is not None
    )


def parse_geom(text: str, source: str = "geom") -> tuple[RpcModel, str]:
    """The RPC of a `.geom`, with its adjustments applied, and what was mended.

    The current adjustment of the list changes the model as OSSIM changes it: offsets and scales along
    and across the track are added to those of the image. A rotation mixes both polynomials, which no
    RPC can express exactly: it is refused.

    Two loaders of OSSIM lose parts of a pixel, and are recognised by products of the whole image: that
    of Pléiades drops the half of an image offset, that of SPOT 6 also counts from 1 in some versions.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Returns:
        The model, and one clause that says what was mended; "" where the numbers are taken as they are.

    Raises:
        FormatError: a line has another form, a key is missing, given twice or not a number, the list
            has no RPC, or its adjustment cannot be expressed.
    """
    values = _parse_keywords(text, source)
    kind = values.get("type", "unknown type")
    order = values.get("polynomial_format", "")[:1]
    if order not in ("A", "B"):
        raise FormatError(
            f"{source}: polynomial_format: expected A or B, found {order or 'none'}; a .geom of "
            f"{kind[:40]} without one holds no RPC: export the RPC of the image, or give its DIMAP"
        )

    def number(key: str) -> float:
        polynomial, _, index = key.partition("_COEFF_")
        name = f"{polynomial.lower()}_coeff_{_position(int(index), order):02d}" if index else _KEYS[key]
        if name not in values:
            if key in ("ERR_BIAS", "ERR_RAND"):
                return math.nan
            raise FormatError(f"{source}: {name} is missing, a number expected")
        return parse_number(values[name], name, source)

    added, mended = _adjustment(values, source), _mended_offsets(values, number, source)
    notes = ["its adjustment applied"] if any(added.values()) else []
    if mended:
        what = ", ".join(
            f"{_KEYS[key]} {number(key):g} taken as {value:g}" for key, value in mended.items()
        )
        notes.append(f"{what}: {kind} loses parts of a pixel")

    def final(key: str) -> float:
        return mended.get(key, number(key)) + added.get(key, 0.0)

    return rpc_from_numbers(final), "; ".join(notes)


def format_geom(model: RpcModel, delivered: str) -> str:
    """The text of a `.geom` of type `ossimRpcModel` with a model; unknown stated errors are zero.

    Args:
        model: the model.
        delivered: text of the delivered file, whose sensor and image identifier are kept.
    """
    values = _parse_keywords(delivered, "geom")
    numbers = {"ERR_BIAS": 0.0, "ERR_RAND": 0.0, **named_numbers(model)}
    lines = {"type": "ossimRpcModel", "polynomial_format": "B"}
    lines |= {key: values[key] for key in ("sensor", "image_id") if values.get(key)}
    for key, value in numbers.items():
        polynomial, _, index = key.partition("_COEFF_")
        name = f"{polynomial.lower()}_coeff_{int(index) - 1:02d}" if index else _KEYS[key]
        lines[name] = repr(value)
    return "".join(f"{name}:  {value}\n" for name, value in sorted(lines.items()))


def parse_geom_acquisition(text: str, image_id: str, source: str = "geom") -> Acquisition:
    """Sensor, time and sun of an image from a `.geom`; incidence and azimuth stay unknown.

    Args:
        text: contents of the file.
        image_id: name of the image.
        source: name of the file, for messages.

    Raises:
        FormatError: a line has another form.
    """
    values = _parse_keywords(text, source)
    sensor = values.get("sensor", "")
    date, _, time = values.get("support_data.image_date", "").partition("T")
    return Acquisition(
        image_id=image_id,
        sensor=_SENSORS.get(sensor, sensor.replace(" ", "")),
        acquired_at=parse_imaging_time(date, time),
        sun_elevation_deg=_middle(values.get("support_data.elevation_angle", ""), source),
        sun_azimuth_deg=_middle(values.get("support_data.azimuth_angle", ""), source),
    )


def _parse_keywords(text: str, source: str) -> dict[str, str]:
    """The values of a keyword list by their keys; text in three quotes may span lines."""
    values: dict[str, str] = {}
    joined = re.sub(r'"""(.*?)"""', lambda found: " ".join(found[1].split()), text, flags=re.DOTALL)
    for count, line in enumerate(joined.lstrip("\ufeff").splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("//"):
            continue
        key, colon, value = (part.strip() for part in line.partition(":"))
        if not colon or not key:
            raise FormatError(f"{source}, line {count}: expected 'key: value', found {line[:60]!r}")
        if key in values:
            raise FormatError(f"{source}, line {count}: {key[:60]} is given twice, once expected")
        values[key] = value
    return values


def _position(index: int, order: str) -> int:
    """Position in the file of a coefficient of RPC00B counted from 1."""
    return index - 1 if order == "B" else RPC00A_ORDER[index - 1]


def _adjustment(values: Mapping[str, str], source: str) -> dict[str, float]:
    """What the current adjustment adds to the numbers of the RPC: center + sigma * parameter of each."""
    count = _whole(values, "number_of_adjustments", source)
    current = f"adjustment_{_whole(values, 'current_adjustment', source)}"
    if count == 0:
        return {}
    added: dict[str, float] = {}
    for k in range(_whole(values, f"{current}.number_of_params", source)):
        stem = f"{current}.adj_param_{k}"
        center, sigma, parameter = (
            parse_number(values.get(f"{stem}.{part}", "0"), f"{stem}.{part}", source)
            for part in ("center", "sigma", "parameter")
        )
        value = center + sigma * parameter
        name = values.get(f"{stem}.description", "")
        if value == 0.0:
            continue
        if name not in _ADJUSTED:
            raise FormatError(
                f"{source}: {stem} ({name[:40] or 'no description'}) is {value:g}, 0 expected: an "
                "RPC cannot express it; give the model without this adjustment, or fit an RPC to it"
            )
        added[_ADJUSTED[name]] = added.get(_ADJUSTED[name], 0.0) + value
    return added


def _whole(values: Mapping[str, str], key: str, source: str) -> int:
    """The count of a key, 0 where it is missing."""
    text = values.get(key, "0")
    if re.fullmatch(r"\d{1,3}", text) is None:
        raise FormatError(f"{source}: {key}: expected a count up to 999, found {text[:60]!r}")
    return int(text)


def _mended_offsets(values: Mapping[str, str], number: Numbers, source: str) -> dict[str, float]:
    """Image offsets that a loader has changed, as the product has them; only where the size tells it.

    The RPC of a whole image of n lines has, in DIMAP counted from 0, for Pléiades the scale and the
    offset (n - 1) / 2, and for SPOT 6 the scale n / 2 and the offset n / 2 - 1.
    """
    kind = values.get("type", "")
    mended: dict[str, float] = {}
    for axis, count_key in (("LINE", "number_lines"), ("SAMP", "number_samples")):
        if count_key not in values:
            continue
        count = parse_number(values[count_key], count_key, source)
        offset, scale = number(f"{axis}_OFF"), number(f"{axis}_SCALE")
        if kind == "ossimPleiadesModel" and scale == (count - 1.0) / 2.0 == offset + 0.5:
            mended[f"{axis}_OFF"] = scale
        if kind == "ossimSpot6Model" and scale == count / 2.0 and offset - scale in (0.0, -0.5, -1.5):
            mended[f"{axis}_OFF"] = scale - 1.0
    return mended


def _middle(text: str, source: str) -> float:
    """The middle one of a list of angles over the image, degrees; NaN without any."""
    angles = [parse_number(angle, "support_data angles", source) for angle in text.split()]
    return angles[len(angles) // 2] if angles else math.nan
