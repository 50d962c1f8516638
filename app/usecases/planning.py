"""Predict the accuracy of a block from a plan: read it, call the science, write the report."""

import time
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
import shapely
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from amers.app.errors import InputError
from amers.app.usecases.registration.result_folder import replacing
from amers.app.usecases.report_files import write_report
from amers.services.formats.stac.catalogue import read_catalogue
from amers.services.formats.text_files import load_json, read_text
from amers.services.geodesy import metres_per_degree
from amers.services.imagery.catalogue import ImageCatalogue
from amers.services.production.block_plan import (
    BlockPlan,
    PlannedHeights,
    PlannedImage,
    PlannedSite,
    SiteSigmas,
)
from amers.services.production.planning import forecast
from amers.services.reports.plan import PlanReport, points_csv
from amers.services.reports.plan_pages import PLAN_PAGE
from amers.services.types import Progress, no_progress

_MAX_CANDIDATES = 200

M = TypeVar("M", bound=BaseModel)
Metres = Annotated[float, Field(gt=0.0, lt=1e7)]
Sigmas = tuple[Metres, Metres]


class _Members(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class _Image(_Members):
    name: str
    lon: Annotated[float, Field(ge=-180.0, le=180.0)]
    lat: Annotated[float, Field(ge=-85.0, le=85.0)]
    along_km: Metres
    across_km: Metres
    gsd_m: Metres
    incidence_deg: Annotated[float, Field(ge=0.0, le=60.0)]
    azimuth_deg: Annotated[float, Field(ge=0.0, le=360.0)]
    sigma_m: Metres
    slope: Annotated[float, Field(gt=0.0, lt=0.1)] = 1e-4
    sigma_px: Annotated[float, Field(gt=0.0, lt=100.0)] = 0.2
    pass_name: Annotated[str, Field(alias="pass")] = ""
    ortho: bool = False


class _Sigmas(_Members):
    points: Annotated[int, Field(ge=1, le=100)] = 5
    sigma_m: Sigmas = (0.3, 0.3)
    frame_sigma_m: Sigmas = (0.3, 0.3)

    def sigmas(self) -> SiteSigmas:
        return SiteSigmas(self.points, self.sigma_m, self.frame_sigma_m)


class _Site(_Sigmas):
    name: str
    lon: Annotated[float, Field(ge=-180.0, le=180.0)]
    lat: Annotated[float, Field(ge=-85.0, le=85.0)]


class _Heights(_Members):
    sigma_m: Metres
    frame_sigma_m: Metres


class _Candidates(_Sigmas):
    spacing_km: Metres


class _Plan(_Members):
    images: list[dict[str, Any]] = []
    image_defaults: dict[str, Any] = {}
    spacing_km: Metres
    ground_m: Annotated[float, Field(ge=-500.0, le=9000.0)] = 0.0
    sites: list[_Site] = []
    heights: _Heights | None = None
    candidates: list[_Site] | _Candidates | None = None
    added: Annotated[int, Field(ge=1, le=20)] = 1


def run_plan(
    source: Path, folder: Path, selection: str | None = None, progress: Progress = no_progress
) -> PlanReport:
    """Write the predicted accuracy of a plan into a folder: report, page, points.

    Args:
        source: the plan, JSON.
        folder: of the result; an older result there is replaced as a whole.
        selection: folder of a selection, or catalogue: its images are planned as well.
        progress: receives the fraction done and a message.

    Raises:
        InputError: the plan, the catalogue or the folder cannot be used.
        ComputationError: the images have too little in common.
    """
    started = time.monotonic()
    with replacing(folder) as new:
        plan = read_plan(source, selection)
        found = forecast(plan, progress)
        report = PlanReport(
            source.stem,
            plan,
            found,
            time.monotonic() - started,
            datetime.now(UTC),
            version("amers"),
        )
        write_report(new, PLAN_PAGE, report)
        (new / "points.csv").write_text(points_csv(report), encoding="utf-8")
    progress(1.0, "done")
    return report


def read_plan(source: Path, selection: str | None = None) -> BlockPlan:
    """The plan of a JSON file, with the images of a selection or catalogue.

    Raises:
        InputError: it has a member that is unknown, missing or out of range.
    """
    document = load_json(read_text(source), str(source))
    plan = _valid(_Plan, document, str(source))
    documents = list(plan.images)
    if selection is not None:
        documents += _catalogue_images(read_catalogue(selection).images)
    images = [
        _valid(_Image, {**plan.image_defaults, **one}, f"{source}: images/{k}")
        for k, one in enumerate(documents)
    ]
    candidates = plan.candidates
    if isinstance(candidates, _Candidates):
        places = _lattice(images, candidates)
    else:
        places = [_site(site) for site in candidates or []]
    return BlockPlan(
        images=tuple(_image(image) for image in images),
        spacing_m=1000.0 * plan.spacing_km,
        ground_m=plan.ground_m,
        sites=tuple(_site(site) for site in plan.sites),
        heights=None
        if plan.heights is None
        else PlannedHeights(plan.heights.sigma_m, plan.heights.frame_sigma_m),
        candidates=tuple(places),
        added=plan.added,
    )


def _valid(kind: type[M], document: Any, source: str) -> M:
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        place = "/".join(str(part) for part in first["loc"])
        found = str(first["input"])[:60]
        raise InputError(f"{source}: {place}: {first['msg']}, {found!r} found") from None


def _image(image: _Image) -> PlannedImage:
    return PlannedImage(
        name=image.name,
        lon_lat=(image.lon, image.lat),
        size_m=(1000.0 * image.along_km, 1000.0 * image.across_km),
        gsd_m=image.gsd_m,
        incidence_deg=image.incidence_deg,
        azimuth_deg=image.azimuth_deg,
        sigma_m=image.sigma_m,
        slope=image.slope,
        sigma_px=image.sigma_px,
        pass_name=image.pass_name,
        is_ortho=image.ortho,
    )


def _site(site: _Site) -> PlannedSite:
    return PlannedSite(site.name, (site.lon, site.lat), site.sigmas())


def _lattice(images: list[_Image], wanted: _Candidates) -> list[PlannedSite]:
    """Candidates on a lattice over the images."""
    box = []
    for image in images:
        half_deg = 500.0 * np.array([image.across_km, image.along_km])
        half_deg /= metres_per_degree(image.lat, 0.0)
        box.append(
            [image.lon - half_deg[0], image.lat - half_deg[1], *(half_deg + [image.lon, image.lat])]
        )
    if not box:
        return []
    (west, south), (east, north) = np.min(box, axis=0)[:2], np.max(box, axis=0)[2:]
    step = 1000.0 * wanted.spacing_km / np.array(metres_per_degree((south + north) / 2.0, 0.0))
    lon = np.arange(west + step[0] / 2.0, east, step[0])
    lat = np.arange(south + step[1] / 2.0, north, step[1])
    if not 1 <= len(lon) * len(lat) <= _MAX_CANDIDATES:
        raise InputError(
            f"candidates/spacing_km: {wanted.spacing_km:g} gives {len(lon) * len(lat)} places, 1 to "
            f"{_MAX_CANDIDATES} expected: state another spacing"
        )
    return [
        PlannedSite(f"{y:.4f} {x:.4f}", (float(x), float(y)), wanted.sigmas()) for y in lat for x in lon
    ]


def _catalogue_images(images: ImageCatalogue) -> list[dict[str, Any]]:
    """What a catalogue states of images: place, size, directions, pass; the defaults add the rest."""
    out = []
    for k in range(len(images)):
        middle = shapely.centroid(images.footprint[k])
        scale = np.array(metres_per_degree(middle.y, 0.0)) / 1000.0
        in_km = shapely.transform(images.footprint[k], lambda xy, by=scale: xy * by)
        corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(in_km))[:3]
        sides_km = np.diff(corners, axis=0)
        along = int(np.argmax(np.abs(sides_km[:, 1]) / np.linalg.norm(sides_km, axis=1)))
        lengths_km = np.linalg.norm(sides_km, axis=1)
        one: dict[str, Any] = {
            "name": str(images.id[k]),
            "lon": (middle.x + 180.0) % 360.0 - 180.0,
            "lat": middle.y,
            "along_km": float(lengths_km[along]),
            "across_km": float(lengths_km[1 - along]),
        }
        for member in ("incidence_deg", "azimuth_deg"):
            value = float(getattr(images, member)[k])
            if np.isfinite(value):
                one[member] = value
        if images.platform[k] and images.orbit[k] >= 0:
            one["pass"] = f"{images.platform[k]} {images.orbit[k]}"
        out.append(one)
    return out
