"""The same replies as pages for people: a table, a small map drawn in SVG, links; no script."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from fastapi import Request
from fastapi.responses import HTMLResponse
from jinja2 import Environment, PackageLoader

from app.db.features.collection import Collection
from app.usecases.features.items import FeaturePage

TEMPLATES = Environment(loader=PackageLoader("app.api", "templates"), autoescape=True)
POLICY = "default-src 'none'; style-src 'unsafe-inline'; form-action 'none'; frame-ancestors 'none'"
MARGIN = 0.05


@dataclass(frozen=True)
class Cell:
    """A cell of a table, perhaps a link."""

    text: str
    href: str = ""


@dataclass(frozen=True)
class Drawing:
    """A map: the box that is seen, outlines and dots as SVG paths, and what it says in words."""

    box: str
    lines: str
    dots: str
    said: str


def document_page(
    request: Request,
    title: str,
    description: str,
    links: Sequence[dict[str, Any]],
    columns: Sequence[str] = (),
    rows: Sequence[Sequence[Cell]] = (),
    drawing: Drawing | None = None,
) -> HTMLResponse:
    """A page."""
    text = TEMPLATES.get_template("page.html").render(
        title=title,
        description=description,
        base=str(request.base_url),
        links=links,
        columns=columns,
        rows=rows,
        map=drawing,
    )
    return HTMLResponse(text, headers={"Content-Security-Policy": POLICY})


def features_page(
    request: Request,
    collection: Collection,
    title: str,
    found: Sequence[dict[str, Any]],
    links: Sequence[dict[str, Any]],
    answer: FeaturePage | None = None,
) -> HTMLResponse:
    """Features as a page."""
    names = [name for name in (found[0]["properties"] if found else {})]
    here = f"{request.base_url}collections/{collection.id}/items"
    rows = [
        [
            Cell(str(feature["id"]), f"{here}/{feature['id']}?f=html"),
            *(Cell(_shown(feature["properties"].get(name))) for name in names),
        ]
        for feature in found
    ]
    said = collection.description
    if answer is not None:
        about = "" if answer.matched.exact else "about "
        said = f"{answer.returned:,} of {about}{answer.matched.number:,}. {said}"
    columns = [collection.key.name, *names]
    return document_page(
        request, title, said, links, columns, rows, drawn(feature["geometry"] for feature in found)
    )


def drawn(geometries: Iterable[dict[str, Any] | None]) -> Drawing | None:
    """Geometries in longitude and latitude, drawn; None without any."""
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
        said=f"{west:.3f} to {east:.3f} east, {south:.3f} to {north:.3f} north",
    )


def _shown(value: Any) -> str:
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
