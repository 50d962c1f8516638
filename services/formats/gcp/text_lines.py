"""Lines and numbers of files of marked points that are plain text."""

from collections.abc import Iterator

import numpy as np

from services.formats.sensor_models.rpc_text import parse_number
from services.types import Array


def lines_of(text: str, comment: str, source: str) -> Iterator[tuple[str, str]]:
    """Lines that say something, each with its place.

    Args:
        comment: what lines that say nothing begin with.
        source: name of the file.
    """
    for count, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith(comment):
            yield f"{source}, line {count}", line.strip()


def numbers_of(fields: list[str], names: list[str], where: str) -> list[float]:
    """Fields as numbers.

    Raises:
        FormatError: naming the field that is none.
    """
    return [parse_number(field, name, where) for field, name in zip(fields, names, strict=True)]


def coordinate_array(coordinates: list[tuple[float, float, float]]) -> Array:
    """Ground points (n, 3), none of them too."""
    return np.array(coordinates, dtype=np.float64).reshape(-1, 3)


def counted_ids(rows: list[tuple[float, float]]) -> list[str]:
    """Names of points that have none: their count from 1."""
    return [str(count) for count in range(1, len(rows) + 1)]


def format_deg(value: float) -> str:
    """To a tenth of a micrometre."""
    return f"{value:.12f}"


def format_m(value: float) -> str:
    """To a micrometre."""
    return f"{value:.6f}"


def format_px(value: float) -> str:
    """To a thousandth of a millionth of a pixel; never "-0"."""
    return f"{value + 0.0:.9f}"


def format_mark(lon_lat_h: Array, line_sample: Array) -> str:
    """Longitude, latitude, height, sample and line, with blanks between them."""
    lon, lat, height_m = lon_lat_h
    line, sample = line_sample
    ground = f"{format_deg(lon)} {format_deg(lat)} {format_m(height_m)}"
    return f"{ground} {format_px(sample)} {format_px(line)}"
