"""Styles that QGIS applies when it opens a layer of a GeoPackage: the table `layer_styles`.

QGIS reads the table when it adds a layer: the row with the name of the layer and of its geometry column
and with `useAsDefault` is applied, the others are offered under *Styles*. Its columns are those that
QGIS makes when it saves a style itself.
"""

import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal, TypeAlias
from xml.etree import ElementTree as ET

from amers.services.conventions import STATUS_COLOURS

COLOURS = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")
"""Viridis, of the classes of a number; readable with every colour vision."""
_PALE = 30
"""Opacity of areas, of 255."""
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
class NumberStyle:
    """Points in classes of a number.

    Attributes:
        name: as QGIS lists it.
        description: what the colours show.
        expression: QGIS expression of the number.
        limits: of the classes, ascending, one more than there are colours.
        unit: of the number, for the legend; "" for none.
    """

    name: str
    description: str
    expression: str
    limits: Sequence[float]
    unit: str


@dataclass(frozen=True)
class WordStyle:
    """Points, or arrows along lines, in classes of a word.

    Attributes:
        name: as QGIS lists it.
        description: what the colours show.
        attribute: with the word.
        colours: by the word.
        symbol: what is drawn.
    """

    name: str
    description: str
    attribute: str
    colours: Mapping[str, str]
    symbol: Literal["disc", "arrow"]


@dataclass(frozen=True)
class AreaStyle:
    """An area with an outline.

    Attributes:
        name: as QGIS lists it.
        description: what the area is.
        colour: of the outline, and of the area, which one sees through.
    """

    name: str
    description: str
    colour: str


Style: TypeAlias = NumberStyle | WordStyle | AreaStyle

LAYER_STYLES: Mapping[str, Sequence[Style]] = {
    "points": (
        NumberStyle(
            "Horizontal sigma",
            "Standard deviation of the position relative to its block, the larger of east and north",
            'max("sigma_east_m", "sigma_north_m")',
            (0.0, 0.5, 1.0, 2.0, 5.0, 1e6),
            "m",
        ),
        NumberStyle(
            "Number of views", "Images that show the point", '"n_views"', (0, 2, 4, 6, 9, 1e6), ""
        ),
    ),
    "held_area": (
        AreaStyle(
            "Held area",
            "The area that control points support: accuracy is stated for it, and for no other part",
            STATUS_COLOURS["active"],
        ),
    ),
    "control_points": (
        WordStyle("Status", "Whether the registration uses the point", "status", STATUS_COLOURS, "disc"),
    ),
    "residuals": (
        WordStyle(
            "Status",
            "Observed minus computed, exaggerated; whether the registration uses the point",
            "status",
            STATUS_COLOURS,
            "arrow",
        ),
    ),
}
"""The styles of a layer by its name; QGIS applies the first."""


def add_styles(path: Path, layers: Sequence[str]) -> None:
    """Add the table of styles to a GeoPackage.

    Args:
        path: of the file, which has no such table yet.
        layers: of the file, each with styles in `LAYER_STYLES`.
    """
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(TABLE)
        database.execute(CONTENTS)
        for layer in layers:
            for number, style in enumerate(LAYER_STYLES[layer]):
                values = (style.name, as_qml(style), number == 0, style.description, layer)
                database.execute(ROW, values)


def as_qml(style: Style) -> str:
    """The style as QGIS writes it: a renderer with one symbol for each class."""
    root = ET.Element("qgis", version="3.22", styleCategories="Symbology")
    if isinstance(style, NumberStyle):
        _add_ranges(root, style)
    elif isinstance(style, AreaStyle):
        _add_area(root, style)
    else:
        _add_categories(root, style)
    return ET.tostring(root, encoding="unicode")


def _add_ranges(root: ET.Element, style: NumberStyle) -> None:
    how = {"type": "graduatedSymbol", "graduatedMethod": "GraduatedColor"}
    renderer = ET.SubElement(root, "renderer-v2", how, attr=style.expression)
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
        _add_disc(symbols, str(number), colour)


def _add_categories(root: ET.Element, style: WordStyle) -> None:
    renderer = ET.SubElement(root, "renderer-v2", type="categorizedSymbol", attr=style.attribute)
    categories, symbols = ET.SubElement(renderer, "categories"), ET.SubElement(renderer, "symbols")
    add_symbol = _add_arrow if style.symbol == "arrow" else _add_disc
    for number, (word, colour) in enumerate(style.colours.items()):
        ET.SubElement(categories, "category", symbol=str(number), value=word, label=word, render="true")
        add_symbol(symbols, str(number), colour)


def _add_area(root: ET.Element, style: AreaStyle) -> None:
    renderer = ET.SubElement(root, "renderer-v2", type="singleSymbol")
    symbols = ET.SubElement(renderer, "symbols")
    symbol = ET.SubElement(symbols, "symbol", type="fill", name="0", alpha="1")
    seen_through = {"color": _channels(style.colour, _PALE), "outline_color": _channels(style.colour)}
    _add_layer(symbol, "SimpleFill", {**seen_through, "outline_width": "0.4"})


def _add_disc(symbols: ET.Element, name: str, colour: str) -> None:
    symbol = ET.SubElement(symbols, "symbol", type="marker", name=name, alpha="1")
    _add_layer(symbol, "SimpleMarker", {"name": "circle", "color": _channels(colour), "size": "2"})


def _add_arrow(symbols: ET.Element, name: str, colour: str) -> None:
    """A straight arrow from the first to the last vertex, millimetres."""
    symbol = ET.SubElement(symbols, "symbol", type="line", name=name, alpha="1")
    shape = {"is_curved": "0", "is_repeated": "0"}
    size = {"arrow_width": "0.4", "arrow_start_width": "0.4", "head_length": "1.6"}
    arrow = _add_layer(symbol, "ArrowLine", {**shape, **size, "head_thickness": "1"})
    inside = ET.SubElement(arrow, "symbol", type="fill", name=f"@{name}@0", alpha="1")
    _add_layer(inside, "SimpleFill", {"color": _channels(colour), "outline_style": "no"})


def _add_layer(symbol: ET.Element, kind: str, properties: Mapping[str, str]) -> ET.Element:
    layer = ET.SubElement(symbol, "layer", {"class": kind}, enabled="1", locked="0")
    for key, value in properties.items():
        ET.SubElement(layer, "prop", k=key, v=value)
    return layer


def _channels(colour: str, opacity: int = 255) -> str:
    """A colour `#rrggbb` as QGIS writes it: red, green, blue, opacity."""
    return ",".join(map(str, (*bytes.fromhex(colour[1:]), opacity)))
