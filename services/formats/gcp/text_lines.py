"""Lines and numbers of marked points in text files."""

from collections.abc import Iterator

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.text_files import parse_number
from amers.services.types import Array


def content_lines(text: str, comment: str, source: str) -> Iterator[tuple[str, str]]:
    """Yield each line that is neither empty nor a comment, after its place in the file.

    Args:
        text: contents of the file.
        comment: prefix of comments.
        source: name of the file.
    """
    for count, line in enumerate(text.splitlines(), start=1):
        if line.strip() and not line.lstrip().startswith(comment):
            yield f"{source}, line {count}", line.strip()


def parse_numbers(fields: list[str], names: list[str], where: str) -> list[float]:
    """The numbers in some fields.

    Raises:
        FormatError: a field is not a number; the message names it.
    """
    return [parse_number(field, name, where) for field, name in zip(fields, names, strict=True)]


def check_lon_lat(lon: float, lat: float, where: str) -> None:
    """Refuse a position that is not on the Earth, such as one with its coordinates swapped.

    Raises:
        FormatError: the latitude is beyond 90 degrees, or the longitude beyond 360.
    """
    if abs(lat) > 90.0 or abs(lon) > 360.0:
        raise FormatError(
            f"{where}: expected a latitude within 90 degrees and a longitude within 360, "
            f"found latitude {lat:g}, longitude {lon:g}"
        )


def coordinate_array(coordinates: list[tuple[float, float, float]]) -> Array:
    """Ground points (n, 3), also for n = 0."""
    return np.array(coordinates, dtype=np.float64).reshape(-1, 3)


def sequential_ids(rows: list[tuple[float, float]]) -> list[str]:
    """Ids "1", "2", … for points of a format without ids."""
    return [str(count) for count in range(1, len(rows) + 1)]


def format_deg(value: float) -> str:
    """Degrees with 12 decimals, a tenth of a micrometre on the ground."""
    return f"{value:.12f}"


def format_m(value: float) -> str:
    """Metres with 6 decimals."""
    return f"{value:.6f}"


def format_px(value: float) -> str:
    """Pixels with 9 decimals, without a negative zero."""
    return f"{value + 0.0:.9f}"


def format_mark(lon_lat_h: Array, line_sample: Array) -> str:
    """Longitude, latitude, height, sample and line, separated by spaces."""
    lon, lat, height_m = lon_lat_h
    line, sample = line_sample
    ground = f"{format_deg(lon)} {format_deg(lat)} {format_m(height_m)}"
    return f"{ground} {format_px(sample)} {format_px(line)}"
