"""Unused columns of CSV files: reported, or refused if they would change the result."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from pyproj import CRS

from amers.services.errors import FormatError, VerticalDatumError
from amers.services.formats.elevation.heights import unit_m
from amers.services.formats.gcp.csv_columns import Head
from amers.services.formats.gcp.csv_table import CsvRow
from amers.services.formats.gcp.record import Record
from amers.services.statements import Subject

_WGS84 = CRS.from_epsg(4326)
_NAMES_OF_WGS84 = {"wgs84", "wgs1984", "4326", "epsg4326", "4979", "epsg4979"}
_DATE = re.compile(r"\d{1,4}[./-]\d{1,2}[./-]\d{1,4}.*")
"""A column "Datum" of a German surveyor has dates."""


@dataclass(frozen=True)
class TakenAs:
    """What the values of a file are taken as.

    Attributes:
        datum: of the heights.
        crs: of the positions.
        is_stated: whether the caller or the file states the reference system, so that no column has to.
    """

    datum: str
    crs: CRS
    is_stated: bool


def record_unused(
    rows: Sequence[CsvRow], unused: Sequence[tuple[int, Head]], taken: TakenAs, record: Record
) -> None:
    """Note the columns that are not read.

    Args:
        rows: of the file.
        unused: places and heads of these columns.
        taken: what the others are taken as.
        record: of the file.

    Raises:
        FormatError: the values of one state another unit, or another reference system.
    """
    for place, head in unused:
        values = sorted({row.fields[place] for row in rows} - {""})
        shown, where = ", ".join(values[:3])[:80], f"column {head.text}"
        if not values:
            if head.text:
                record.not_used(head.subject, "empty", where)
        elif head.states is Subject.UNIT:
            _check_metres(values, f"{record.file}, {where}")
            record.used(Subject.UNIT, shown, where)
        elif head.states is Subject.VERTICAL_DATUM:
            record.not_used(Subject.VERTICAL_DATUM, shown, where, f"heights above {taken.datum}")
        elif head.states is None:
            record.not_used(head.subject, shown, where)
        elif all(map(_DATE.fullmatch, values)):
            record.not_used(Subject.EPOCH, shown, where)
        elif _is_wgs84(values) and taken.crs == _WGS84:
            record.used(Subject.HORIZONTAL_DATUM, shown, where)
        elif taken.is_stated:
            record.not_used(Subject.HORIZONTAL_DATUM, shown, where, f"taken as {taken.crs.name}")
        else:
            raise FormatError(
                f"{record.file}, {where}: expected WGS 84 of lon and lat, found {shown}; state the "
                "reference system (--crs)"
            )


def _is_wgs84(values: Sequence[str]) -> bool:
    return {re.sub(r"[\W_]", "", value.lower()) for value in values} <= _NAMES_OF_WGS84


def _check_metres(values: Sequence[str], where: str) -> None:
    for value in values:
        try:
            is_metre = unit_m(value, where, "") == 1.0
        except VerticalDatumError:
            is_metre = False
        if not is_metre:
            raise FormatError(
                f"{where}: expected metres, found {value[:40]}; state the unit in the name of the "
                "column of heights, such as height_ft, and remove this column"
            )
