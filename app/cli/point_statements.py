"""What commands state about files of ground points."""

from pathlib import Path

from amers.app.errors import InputError
from amers.services.formats.gcp.csv_points import CsvLayout, parse_columns
from amers.services.formats.gcp.reader import StatedByCaller
from amers.services.formats.gcp.text_formats import ECEF, LAT_LON_HEIGHT


def stated_by_caller(
    heights: str | Path | None,
    crs: str | None,
    columns: str | None,
    sigma_axes: str | None,
    options: str = "--",
) -> StatedByCaller:
    """What the options of a command state about a file of points.

    Args:
        heights: vertical datum, or grid file of a geoid.
        crs: reference system of x and y of a CSV.
        columns: of a CSV: lon=COLUMN,lat=COLUMN,…
        sigma_axes: of the sigmas of an ASP file.
        options: first letters of these options.

    Raises:
        InputError: the axes or the columns are wrong.
    """
    if sigma_axes not in (None, ECEF, LAT_LON_HEIGHT):
        raise InputError(
            f"axes of sigmas: {sigma_axes[:40]!r} found, {ECEF} or {LAT_LON_HEIGHT} expected"
        )
    layout = CsvLayout({} if columns is None else parse_columns(columns), crs)
    return StatedByCaller(heights, sigma_axes, layout, options)


def sigma_pair(text: str | None, option: str) -> tuple[float, float] | None:
    """The horizontal and the vertical sigma of an option; None where it is not given.

    Raises:
        InputError: the text is something else.
    """
    if text is None:
        return None
    try:
        horizontal_m, up_m = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"{option}: {text!r} found, HORIZONTAL,UP such as 3,5 expected") from None
    if not (0.0 < horizontal_m < 1e6 and 0.0 < up_m < 1e6):
        raise InputError(f"{option}: {text!r} found, two positive lengths in metres expected")
    return horizontal_m, up_m
