"""Styles that QGIS applies when it opens a layer of a GeoPackage: the table `layer_styles`.

QGIS reads the table when it adds a layer: the row with the name of the layer and of its geometry column
and with `useAsDefault` is applied, the others are offered under *Styles*. Its columns are those that
QGIS makes when it saves a style itself.
"""

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

COLOURS = ("68,1,84", "59,82,139", "33,145,140", "94,201,98", "253,231,37")
"""Viridis: red, green, blue of the classes; readable with every colour vision."""
TABLE = """
CREATE TABLE layer_styles (
    id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    f_table_catalog TEXT(256), f_table_schema TEXT(256), f_table_name TEXT(256),
    f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT, styleSLD TEXT,
    useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30),
    update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')))
"""
CONTENTS = """
INSERT INTO gpkg_contents (table_name, data_type, identifier)
VALUES ('layer_styles', 'attributes', 'layer_styles')
"""
ROW = """
INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName,
    styleQML, styleSLD, useAsDefault, description, owner)
SELECT '', '', table_name, column_name, ?, ?, '', ?, ?, ''
FROM gpkg_geometry_columns WHERE table_name = ?
"""


@dataclass(frozen=True)
class Style:
    """Points in classes of colour.

    Attributes:
        name: as QGIS lists it.
        description: what the colours show.
        expression: QGIS expression of the value that is classified.
        limits: of the classes, ascending, one more than there are colours.
        unit: of the value, for the legend; "" for none.
    """

    name: str
    description: str
    expression: str
    limits: Sequence[float]
    unit: str


LAYER_STYLES = {
    "points": (
        Style(
            "Horizontal sigma",
            "Standard deviation of the position in the frame of its block, the larger of east and north",
            'max("sigma_east_m", "sigma_north_m")',
            (0.0, 0.5, 1.0, 2.0, 5.0, 1e6),
            "m",
        ),
        Style("Number of views", "Images that see the point", '"n_views"', (0, 2, 4, 6, 9, 1e6), ""),
    )
}
"""The styles of a layer by its name; QGIS applies the first."""


def add_styles(path: Path, layer: str, styles: Sequence[Style]) -> None:
    """Add the table of styles to a GeoPackage.

    Args:
        path: of the file, which has no such table yet.
        layer: of points.
        styles: of the layer; QGIS applies the first.
    """
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(TABLE)
        database.execute(CONTENTS)
        for number, style in enumerate(styles):
            values = (style.name, as_qml(style), number == 0, style.description, layer)
            database.execute(ROW, values)


def as_qml(style: Style) -> str:
    """The style as QGIS writes it: a renderer with one marker for each class."""
    root = ET.Element("qgis", version="3.22", styleCategories="Symbology")
    renderer = ET.SubElement(
        root,
        "renderer-v2",
        type="graduatedSymbol",
        attr=style.expression,
        graduatedMethod="GraduatedColor",
    )
    ranges, symbols = ET.SubElement(renderer, "ranges"), ET.SubElement(renderer, "symbols")
    for number, (colour, (lower, upper)) in enumerate(zip(COLOURS, pairwise(style.limits), strict=True)):
        is_last = number == len(COLOURS) - 1
        # A value at a limit belongs to the lower class: QGIS takes the first range that has it.
        label = f"over {lower:g}" if is_last else f"up to {upper:g}"
        ET.SubElement(
            ranges,
            "range",
            symbol=str(number),
            lower=str(lower),
            upper=str(upper),
            label=f"{label} {style.unit}".rstrip(),
            render="true",
        )
        symbol = ET.SubElement(symbols, "symbol", type="marker", name=str(number), alpha="1")
        marker = ET.SubElement(symbol, "layer", {"class": "SimpleMarker"}, enabled="1", locked="0")
        for key, value in (("name", "circle"), ("color", f"{colour},255"), ("size", "2")):
            ET.SubElement(marker, "prop", k=key, v=value)
    return ET.tostring(root, encoding="unicode")
