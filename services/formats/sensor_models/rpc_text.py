"""RPC text files: GDAL's `_RPC.TXT` and DigitalGlobe's `.RPB`.

Both have the centre of the first pixel at (0, 0) and heights above the ellipsoid, as `RpcModel` has.
Numbers are written with the digits that reproduce them exactly.
"""

import math
import re
from collections.abc import Callable

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.formats.text_files import NUMBER_PATTERN, parse_number
from amers.services.sensors.rpc import RpcModel
from amers.services.statements import Subject
from amers.services.types import Array

RPC_TEXT_READER = Reader(
    "RPC as text (`_RPC.TXT`, `.rpc`)",
    ("parse_rpc_text",),
    (
        Treatment(
            Subject.MODEL, "used", "Lines `KEY: number` or `KEY=number`, in any order, state the RPC."
        ),
        Treatment(
            Subject.MODEL, "refused", "A key is missing or occurs twice, or its value is not a number."
        ),
        Treatment(Subject.UNIT, "refused", "The unit after a number is not pixels, degrees or metres."),
        Treatment(Subject.ACCURACY, "used", "ERR_BIAS and ERR_RAND are positive numbers, in metres."),
        Treatment(
            Subject.ACCURACY,
            "assumed",
            "The file states no accuracy: Amers uses the accuracy of the sensor if it "
            "knows the sensor, otherwise 50 m.",
        ),
        Treatment(
            Subject.IDENTITY,
            "refused",
            "A line contains text instead of a number, such as the name of a satellite.",
        ),
    ),
    never=(
        Subject.PLACE,
        Subject.PIXEL_ORIGIN,
        Subject.HORIZONTAL_DATUM,
        Subject.VERTICAL_DATUM,
        Subject.EPOCH,
        Subject.ORDER,
        Subject.VALIDITY,
        Subject.BANDS,
    ),
)
RPB_READER = Reader(
    "DigitalGlobe `.RPB`",
    ("parse_rpb",),
    (
        Treatment(Subject.MODEL, "used", "The fields of the group IMAGE state the RPC."),
        Treatment(
            Subject.PLACE,
            "used",
            "The `.TIL` file of the product states the position of a tile in its image.",
        ),
        Treatment(
            Subject.PLACE,
            "assumed",
            "The product has no `.TIL` file: the RPB belongs to the tile itself.",
        ),
        Treatment(Subject.ORDER, "refused", "SpecId is not RPC00B."),
        Treatment(Subject.ACCURACY, "used", "errBias and errRand are positive numbers, in metres."),
        Treatment(
            Subject.IDENTITY,
            "used",
            "satId states the sensor, and the `.IMD` file the time of the first image line.",
        ),
        Treatment(
            Subject.BANDS,
            "named",
            "bandId states a band. Amers uses the model for all bands of the image.",
        ),
    ),
    never=(
        Subject.PIXEL_ORIGIN,
        Subject.HORIZONTAL_DATUM,
        Subject.VERTICAL_DATUM,
        Subject.UNIT,
        Subject.EPOCH,
        Subject.VALIDITY,
    ),
)

Numbers = Callable[[str], float]
"""Returns the number of a key in the names of GDAL, such as `LINE_OFF` or `SAMP_DEN_COEFF_20`."""

_TEXT_LINE = re.compile(rf"\s*(\w+)\s*[:=]\s*({NUMBER_PATTERN})(?:\s+([A-Za-z]+))?\s*")
_PIXELS = ("pixels", "pixel", "px", "pix")
_DEGREES = ("degrees", "degree", "deg")
_METRES = ("metres", "meters", "metre", "meter", "m")
_UNITS = {
    **dict.fromkeys(("LINE", "SAMP"), _PIXELS),
    **dict.fromkeys(("LAT", "LONG"), _DEGREES),
    **dict.fromkeys(("HEIGHT", "ERR"), _METRES),
}
"""By the start of a key, the units in which its number may be stated."""
_RPB_NUMBER = re.compile(rf"\s*(\w+)\s*=\s*({NUMBER_PATTERN})\s*;?\s*")
_RPB_LIST = re.compile(r"\b(\w+)\s*=\s*\(([^()]*)\)")

RPC00A_ORDER = (0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 7, 11, 14, 17, 12, 15, 18, 13, 16, 19)
"""Positions in RPC00A of the terms of RPC00B. Source: NGA STDI-0002."""

_POLYNOMIALS = ("LINE_NUM", "LINE_DEN", "SAMP_NUM", "SAMP_DEN")
RPB_KEYS = {
    "LINE_OFF": "lineOffset",
    "SAMP_OFF": "sampOffset",
    "LAT_OFF": "latOffset",
    "LONG_OFF": "longOffset",
    "HEIGHT_OFF": "heightOffset",
    "LINE_SCALE": "lineScale",
    "SAMP_SCALE": "sampScale",
    "LAT_SCALE": "latScale",
    "LONG_SCALE": "longScale",
    "HEIGHT_SCALE": "heightScale",
}
RPB_LISTS = {
    "LINE_NUM": "lineNumCoef",
    "LINE_DEN": "lineDenCoef",
    "SAMP_NUM": "sampNumCoef",
    "SAMP_DEN": "sampDenCoef",
}


def parse_rpc_text(text: str, source: str = "RPC text") -> RpcModel:
    """The RPC of a `_RPC.TXT`: one `KEY: number` on each line, with an optional unit.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: a line has another form, a number is in another unit than pixels, degrees and
            metres, or a key is missing or given twice.
    """
    numbers: dict[str, float] = {}
    for count, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        match = _TEXT_LINE.fullmatch(line)
        if match is None:
            raise FormatError(f"{source}, line {count}: expected 'KEY: number', found {line[:60]!r}")
        key, unit = match[1].upper(), (match[3] or "").lower()
        expected = _UNITS.get(key.partition("_")[0], ())
        if unit and unit not in expected:
            raise FormatError(
                f"{source}, line {count}: {key} in {match[3][:20]!r} found, "
                f"{expected[0] if expected else 'a number without a unit'} expected: convert it"
            )
        _add(numbers, key, match[2], source)
    return rpc_from_numbers(_lookup(numbers, source))


def format_rpc_text(model: RpcModel) -> str:
    """The text of a `_RPC.TXT` with a model; unknown stated errors are omitted."""
    numbers = named_numbers(model)
    return "".join(f"{key}: {value!r}\n" for key, value in numbers.items())


def parse_rpb(text: str, source: str = "RPB") -> RpcModel:
    """The RPC of a DigitalGlobe `.RPB` with coefficients in the order of RPC00B.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: a field is missing, given twice or not a number, or the order is not RPC00B.
    """
    order = re.search(r"\bspecId\s*=\s*\"?(\w+)", text, re.IGNORECASE)
    if order is None or order[1].upper() != "RPC00B":
        raise FormatError(f"{source}: SpecId: expected RPC00B, found {order[1] if order else 'none'}")
    key_of = {name.lower(): key for key, name in RPB_KEYS.items()}
    key_of |= {"errbias": "ERR_BIAS", "errrand": "ERR_RAND"}
    polynomial_of = {name.lower(): key for key, name in RPB_LISTS.items()}
    numbers: dict[str, float] = {}
    for name, values in _RPB_LIST.findall(text):
        polynomial = polynomial_of.get(name.lower())
        if polynomial is not None:
            for i, value in enumerate(values.split(","), start=1):
                _add(numbers, f"{polynomial}_COEFF_{i}", value, source)
    for line in text.splitlines():
        match = _RPB_NUMBER.fullmatch(line)
        if match is not None and match[1].lower() in key_of:
            _add(numbers, key_of[match[1].lower()], match[2], source)
    return rpc_from_numbers(_lookup(numbers, source))


def rpb_satellite(text: str) -> str:
    """The `satId` of a `.RPB`; "" when it has none."""
    match = re.search(r"\bsatId\s*=\s*\"?(\w+)", text, re.IGNORECASE)
    return match[1] if match else ""


def format_rpb(model: RpcModel, satellite: str = "") -> str:
    """The text of a DigitalGlobe `.RPB` with a model; unknown stated errors are written as zero.

    Args:
        model: the model.
        satellite: content of the field `satId`.
    """
    numbers = named_numbers(model)
    lines = [
        f'satId = "{satellite}";',
        'bandId = "P";',
        'SpecId = "RPC00B";',
        "BEGIN_GROUP = IMAGE",
        f"\terrBias = {numbers.get('ERR_BIAS', 0.0)!r};",
        f"\terrRand = {numbers.get('ERR_RAND', 0.0)!r};",
    ]
    lines += [f"\t{name} = {numbers[key]!r};" for key, name in RPB_KEYS.items()]
    for key, name in RPB_LISTS.items():
        values = ",\n".join(f"\t\t\t{numbers[f'{key}_COEFF_{i}']!r}" for i in range(1, 21))
        lines += [f"\t{name} = (", values + ");"]
    return "\n".join([*lines, "END_GROUP = IMAGE", "END;", ""])


def rpc_from_numbers(number: Numbers, first_pixel: tuple[float, float] = (0.0, 0.0)) -> RpcModel:
    """The RPC with given numbers.

    Args:
        number: returns the number of a key, or raises FormatError when the key is missing; NaN for the
            stated errors, `ERR_BIAS` and `ERR_RAND`, when unknown.
        first_pixel: line and sample of the centre of the first pixel in the convention of the numbers.
    """

    def polynomial(name: str) -> Array:
        return np.array([number(f"{name}_COEFF_{i}") for i in range(1, 21)])

    def numbers(keys: str) -> Array:
        return np.array([number(key) for key in keys.split()])

    return RpcModel(
        line_num=polynomial("LINE_NUM"),
        line_den=polynomial("LINE_DEN"),
        sample_num=polynomial("SAMP_NUM"),
        sample_den=polynomial("SAMP_DEN"),
        image_offset=numbers("LINE_OFF SAMP_OFF") - np.array(first_pixel),
        image_scale=numbers("LINE_SCALE SAMP_SCALE"),
        ground_offset=numbers("LONG_OFF LAT_OFF HEIGHT_OFF"),
        ground_scale=numbers("LONG_SCALE LAT_SCALE HEIGHT_SCALE"),
        error_bias_m=_known_error(number("ERR_BIAS")),
        error_random_m=_known_error(number("ERR_RAND")),
    )


def _known_error(value: float) -> float:
    """The stated error; NaN for -1 or 0, which producers write when it is unknown."""
    return value if value > 0.0 else math.nan


def _add(numbers: dict[str, float], key: str, text: str, source: str) -> None:
    if key in numbers:
        raise FormatError(f"{source}: {key} is given twice, once expected")
    numbers[key] = parse_number(text, key, source)


def _lookup(numbers: dict[str, float], source: str) -> Numbers:
    def number(key: str) -> float:
        if key in numbers:
            return numbers[key]
        if key in ("ERR_BIAS", "ERR_RAND"):
            return math.nan
        raise FormatError(f"{source}: {key} is missing, a number expected")

    return number


def named_numbers(model: RpcModel) -> dict[str, float]:
    """The numbers of a model by their keys; unknown stated errors are omitted."""
    line, sample = model.image_offset.tolist()
    line_scale, sample_scale = model.image_scale.tolist()
    lon, lat, height = model.ground_offset.tolist()
    lon_scale, lat_scale, height_scale = model.ground_scale.tolist()
    numbers = {
        "ERR_BIAS": model.error_bias_m,
        "ERR_RAND": model.error_random_m,
        "LINE_OFF": line,
        "SAMP_OFF": sample,
        "LAT_OFF": lat,
        "LONG_OFF": lon,
        "HEIGHT_OFF": height,
        "LINE_SCALE": line_scale,
        "SAMP_SCALE": sample_scale,
        "LAT_SCALE": lat_scale,
        "LONG_SCALE": lon_scale,
        "HEIGHT_SCALE": height_scale,
    }
    polynomials = (model.line_num, model.line_den, model.sample_num, model.sample_den)
    for name, coefficients in zip(_POLYNOMIALS, polynomials, strict=True):
        numbers |= {f"{name}_COEFF_{i}": c for i, c in enumerate(coefficients.tolist(), start=1)}
    return {key: value for key, value in numbers.items() if not math.isnan(value)}
