"""The page of one control point: its place, its accuracy, its chips and its history."""

from dataclasses import dataclass

from fastapi import Request
from fastapi.responses import HTMLResponse

from amers.app.api.pages import Page, document_page
from amers.app.db.point_detail import PointDetail, PointView
from amers.app.usecases.features.points import point_accuracy


@dataclass(frozen=True)
class ChipFigure:
    """A chip as the page shows it.

    Attributes:
        href: address of the chip, without its format.
        caption: lines below the picture.
    """

    view: int
    href: str
    caption: tuple[str, ...]


def point_page(request: Request, point: PointDetail) -> HTMLResponse:
    """A point as a page for people."""
    collection = f"{request.base_url}collections/points"
    here = f"{collection}/items/{point.id}"
    links = [
        {"rel": "collection", "href": f"{collection}?f=html", "title": "All points"},
        {"rel": "alternate", "href": f"{here}?f=json", "title": "This point as GeoJSON"},
        {"rel": "related", "href": f"{here}/chips?f=npz", "title": "All chips as NPZ"},
    ]
    return document_page(
        request,
        Page(f"Point {point.id}", f"Of block {point.block}, version {point.block_version}.", links),
        "point.html",
        parts={
            "Place": _place(point),
            "Accuracy": point_accuracy(point).words | _sigmas(point),
            "Registrations": _history(point),
        },
        chips=[
            ChipFigure(view.view, f"{here}/chips/{view.view}", _caption(view)) for view in point.views
        ],
    )


def _place(point: PointDetail) -> dict[str, str]:
    north, east = "N" if point.lat_deg >= 0.0 else "S", "E" if point.lon_deg >= 0.0 else "W"
    surface = (
        {}
        if point.surface_height_m is None
        else {"Surface at the point": f"{point.surface_height_m:.2f} m above WGS 84"}
    )
    return {
        "Latitude": f"{abs(point.lat_deg):.8f}\N{DEGREE SIGN} {north}",
        "Longitude": f"{abs(point.lon_deg):.8f}\N{DEGREE SIGN} {east}",
        "Height": f"{point.height_m:.2f} m above WGS 84",
        **surface,
    }


def _sigmas(point: PointDetail) -> dict[str, str]:
    """Standard deviations in the frame of the block."""
    sigmas = (point.sigma_east_m, point.sigma_north_m, point.sigma_up_m)
    return {"Sigma east, north, up": ", ".join(f"{sigma:.2f} m" for sigma in sigmas)}


def _caption(view: PointView) -> tuple[str, ...]:
    """Image, date, size of pixels and direction of a view, as far as they are known."""
    lines = [" ".join(part for part in (view.sensor, view.image_id) if part)]
    if view.acquired_at is not None:
        lines.append(f"taken {view.acquired_at:%Y-%m-%d %H:%M} UTC")
    lines.append(f"pixels of {view.gsd_m:g} m")
    if view.incidence_deg is not None:
        lines.append(f"{view.incidence_deg:.0f}\N{DEGREE SIGN} from the vertical")
    if view.sun_elevation_deg is not None:
        lines.append(f"sun {view.sun_elevation_deg:.0f}\N{DEGREE SIGN} high")
    return tuple(lines)


def _history(point: PointDetail) -> dict[str, str]:
    history = point.history
    tried = f"{history.successes} of {history.attempts} scenes that tried it"
    facts = {
        "State": history.state,
        "Served in": tried if history.attempts else "no scene has tried it yet",
    }
    if history.last_attempt is not None:
        facts["Last tried"] = f"{history.last_attempt:%Y-%m-%d}"
    if history.mean_residual_px is not None:
        facts["Mean residual"] = f"{history.mean_residual_px:.2f} px"
    return facts
