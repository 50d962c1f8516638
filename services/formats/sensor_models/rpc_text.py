"""RPC text files: GDAL's `_RPC.TXT` and DigitalGlobe's `.RPB`.

Both count pixels from the centre of the first one, at (0, 0), and heights from the ellipsoid, as the
models do. Numbers are written so that they read back exactly.
"""

import math
import re
from collections.abc import Callable

import numpy as np

from services.errors import FormatError
from services.sensors.rpc import RpcModel
from services.types import Array

Numbers = Callable[[str], float]
"""Gives the number of a key of the GDAL convention, `LINE_OFF` or `SAMP_DEN_COEFF_20`, or raises."""

_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_TEXT_LINE = re.compile(rf"\s*(\w+)\s*[:=]\s*({_NUMBER})(?:\s+[A-Za-z]+)?\s*")
_RPB_NUMBER = re.compile(rf"\s*(\w+)\s*=\s*({_NUMBER})\s*;?\s*")
_RPB_LIST = re.compile(r"\b(\w+)\s*=\s*\(([^()]*)\)")

_POLYNOMIALS = ("LINE_NUM", "LINE_DEN", "SAMP_NUM", "SAMP_DEN")
_RPB_KEYS = {
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
_RPB_LISTS = {
    "LINE_NUM": "lineNumCoef",
    "LINE_DEN": "lineDenCoef",
    "SAMP_NUM": "sampNumCoef",
    "SAMP_DEN": "sampDenCoef",
}


def parse_rpc_text(text: str, source: str = "RPC text") -> RpcModel:
    """Read a `_RPC.TXT`: one `KEY: number` a line, units after the number allowed.

    Args:
        text: contents of the file.
        source: its name, for the messages.

    Raises:
        FormatError: when a line is not of that form, or a key is missing or given twice.
    """
    found: dict[str, float] = {}
    for count, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        match = _TEXT_LINE.fullmatch(line)
        if match is None:
            raise FormatError(f"{source}, line {count}: expected 'KEY: number', found {line[:60]!r}")
        _add(found, match[1].upper(), match[2], source)
    return rpc_from_numbers(_lookup(found, source))


def format_rpc_text(model: RpcModel) -> str:
    """A model as a `_RPC.TXT`; the stated errors are left out when unknown."""
    numbers = _numbers(model)
    return "".join(f"{key}: {value!r}\n" for key, value in numbers.items())


def parse_rpb(text: str, source: str = "RPB") -> RpcModel:
    """Read a DigitalGlobe `.RPB` of the RPC00B order.

    Args:
        text: contents of the file.
        source: its name, for the messages.

    Raises:
        FormatError: when a field is missing, given twice, not a number, or the order is not RPC00B.
    """
    order = re.search(r"\bspecId\s*=\s*\"?(\w+)", text, re.IGNORECASE)
    if order is None or order[1].upper() != "RPC00B":
        raise FormatError(f"{source}: expected SpecId RPC00B, found {order[1] if order else 'none'}")
    key_of = {name.lower(): key for key, name in _RPB_KEYS.items()}
    key_of |= {"errbias": "ERR_BIAS", "errrand": "ERR_RAND"}
    polynomial_of = {name.lower(): key for key, name in _RPB_LISTS.items()}
    found: dict[str, float] = {}
    for name, values in _RPB_LIST.findall(text):
        polynomial = polynomial_of.get(name.lower())
        if polynomial is not None:
            for i, value in enumerate(values.split(","), start=1):
                _add(found, f"{polynomial}_COEFF_{i}", value, source)
    for line in text.splitlines():
        match = _RPB_NUMBER.fullmatch(line)
        if match is not None and match[1].lower() in key_of:
            _add(found, key_of[match[1].lower()], match[2], source)
    return rpc_from_numbers(_lookup(found, source))


def rpb_satellite(text: str) -> str:
    """The `satId` of a `.RPB`, "" when it has none."""
    match = re.search(r"\bsatId\s*=\s*\"?(\w+)", text, re.IGNORECASE)
    return match[1] if match else ""


def format_rpb(model: RpcModel, satellite: str = "", band: str = "P") -> str:
    """A model as a DigitalGlobe `.RPB`; unknown errors are written as zero.

    Args:
        model: the model.
        satellite: its `satId`.
        band: its `bandId`.
    """
    numbers = _numbers(model)
    lines = [
        f'satId = "{satellite}";',
        f'bandId = "{band}";',
        'SpecId = "RPC00B";',
        "BEGIN_GROUP = IMAGE",
        f"\terrBias = {numbers.get('ERR_BIAS', 0.0)!r};",
        f"\terrRand = {numbers.get('ERR_RAND', 0.0)!r};",
    ]
    lines += [f"\t{name} = {numbers[key]!r};" for key, name in _RPB_KEYS.items()]
    for key, name in _RPB_LISTS.items():
        values = ",\n".join(f"\t\t\t{numbers[f'{key}_COEFF_{i}']!r}" for i in range(1, 21))
        lines += [f"\t{name} = (", values + ");"]
    return "\n".join([*lines, "END_GROUP = IMAGE", "END;", ""])


def rpc_from_numbers(number: Numbers, first_pixel: tuple[float, float] = (0.0, 0.0)) -> RpcModel:
    """The model whose numbers are known by their keys of the GDAL convention.

    Args:
        number: from keys to numbers; raises FormatError for those it does not know. The stated errors,
            `ERR_BIAS` and `ERR_RAND`, are asked for too and must be NaN when unknown.
        first_pixel: line and sample the numbers give to the centre of the first pixel.
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


def parse_number(text: str, key: str, source: str) -> float:
    """A decimal number.

    Raises:
        FormatError: when the text is anything else, "nan" and "inf" included.
    """
    if re.fullmatch(_NUMBER, text.strip()) is None:
        raise FormatError(f"{source}: {key} should be a number, found {text.strip()[:60]!r}")
    return float(text)


def _known_error(value: float) -> float:
    """Producers write -1 or 0 when they do not know."""
    return value if value > 0.0 else math.nan


def _add(found: dict[str, float], key: str, text: str, source: str) -> None:
    if key in found:
        raise FormatError(f"{source}: {key} is given twice")
    found[key] = parse_number(text, key, source)


def _lookup(found: dict[str, float], source: str) -> Numbers:
    def number(key: str) -> float:
        if key in found:
            return found[key]
        if key in ("ERR_BIAS", "ERR_RAND"):
            return math.nan
        raise FormatError(f"{source}: {key} is missing")

    return number


def _numbers(model: RpcModel) -> dict[str, float]:
    """The numbers of a model by their keys of the GDAL convention; unknown errors left out."""
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
