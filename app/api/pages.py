"""Replies as HTML: a table, a small map in SVG, links; no script."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from fastapi import Request
from fastapi.responses import HTMLResponse
from jinja2 import Environment, PackageLoader

from amers.app.api.models.base import Link
from amers.app.api.session_cookie import COOKIE
from amers.app.db.features.collection import Collection
from amers.app.usecases.features.items import FeaturePage

TEMPLATES = Environment(loader=PackageLoader("amers.app.api", "templates"), autoescape=True)
POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src 'self' data:; form-action 'self'; "
    "frame-ancestors 'none'"
)
MARGIN = 0.05


@dataclass(frozen=True)
class Cell:
    """A cell of a table, with the address of a link or without."""

    text: str
    href: str = ""


@dataclass(frozen=True)
class Drawing:
    """A map.

    Attributes:
        box: the box that is seen, as `viewBox` has it.
        lines, dots: outlines and positions as SVG paths.
        text: the box in words.
    """

    box: str
    lines: str
    dots: str
    text: str


@dataclass(frozen=True)
class Page:
    """What a page shows.

    Attributes:
        links: links, or their members.
        columns: heads of the table.
        rows: of the table; an empty table is not shown.
    """

    title: str
    description: str = ""
    links: Sequence[Link | dict[str, Any]] = ()
    columns: Sequence[str] = ()
    rows: Sequence[Sequence[Cell]] = ()
    drawing: Drawing | None = None


def document_page(
    request: Request, page: Page, template: str = "page.html", **more: Any
) -> HTMLResponse:
    """A page as HTML.

    Args:
        template: extends `page.html`.
        more: what else the template shows.
    """
    signed_in = COOKIE in request.cookies
    text = TEMPLATES.get_template(template).render(
        page=page, base=str(request.base_url), signed_in=signed_in, **more
    )
    return HTMLResponse(text, headers={"Content-Security-Policy": POLICY})


def features_page(
    request: Request, collection: Collection, features: Sequence[dict[str, Any]], page: Page
) -> HTMLResponse:
    """Features as HTML: a map, and a table with a row for each.

    Args:
        page: title, description and links.
    """
    names = list(features[0]["properties"]) if features else []
    absent = {name: item.absent for name, item in collection.columns.items()}
    here = f"{request.base_url}collections/{collection.id}/items"
    rows = [
        [
            Cell(str(feature["id"]), f"{here}/{feature['id']}?f=html"),
            *(Cell(_shown(feature["properties"].get(name), absent.get(name, ""))) for name in names),
        ]
        for feature in features
    ]
    drawing = drawn(feature["geometry"] for feature in features)
    columns = [collection.key.name, *names]
    return document_page(request, replace(page, columns=columns, rows=rows, drawing=drawing))


def count_text(page: FeaturePage) -> str:
    """How many features a page has, of how many."""
    about = "" if page.matched.exact else "about "
    return f"{page.returned:,} of {about}{page.matched.number:,}."


def drawn(geometries: Iterable[dict[str, Any] | None]) -> Drawing | None:
    """A map of geometries in longitude and latitude; None without any."""
    dots, rings = [], []
    for geometry in geometries:
        if geometry is None:
            continue
        if geometry["type"] == "Point":
            dots.append(geometry["coordinates"][:2])
        elif geometry["type"] == "Polygon":
            rings += geometry["coordinates"]
        elif geometry["type"] == "MultiPolygon":
            rings += [ring for polygon in geometry["coordinates"] for ring in polygon]
    positions = dots + [position for ring in rings for position in ring]
    if not positions:
        return None
    west, east = min(p[0] for p in positions), max(p[0] for p in positions)
    south, north = min(p[1] for p in positions), max(p[1] for p in positions)
    margin = max(east - west, north - south) * MARGIN or 0.01
    box = (west - margin, -north - margin, east - west + 2 * margin, north - south + 2 * margin)
    return Drawing(
        box=" ".join(f"{value:.6g}" for value in box),
        lines="".join("M" + "L".join(f"{p[0]:.6f} {-p[1]:.6f}" for p in ring) + "Z" for ring in rings),
        dots="".join(f"M{p[0]:.6f} {-p[1]:.6f}h0" for p in dots),
        text=f"{west:.3f} to {east:.3f} east, {south:.3f} to {north:.3f} north",
    )


def _shown(value: Any, absent: str) -> str:
    return absent if value is None else f"{value:g}" if isinstance(value, float) else str(value)
