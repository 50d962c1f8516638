"""Marks in a scene while a person sets them: adjusted at once, for the owner of the model's job."""

import math
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from amers.app.api.deps import InstallationDep, Registrar
from amers.app.api.jobs import JobId
from amers.app.api.models import marks as models
from amers.app.api.models.base import stated_accuracy
from amers.app.api.routes import CallerRoute
from amers.app.errors import InputError
from amers.app.usecases import jobs, marking
from amers.app.usecases.marked_files import PointStatements
from amers.services.quality.accuracy_statement import accuracy_document

router = APIRouter(tags=["jobs"], route_class=CallerRoute)

MOST_MARKS = 200
MOST_PLACES = 20
Finite = Annotated[float, Field(allow_inf_nan=False)]
Longitude = Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]
Latitude = Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)]
Height = Annotated[float, Field(ge=-12000, le=9000, allow_inf_nan=False)]
Sigma = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Sigmas = tuple[Sigma, Sigma]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Mark(_Body):
    """A mark as a person set it; the centre of the first pixel is line 0, sample 0."""

    name: str = Field(min_length=1, max_length=100)
    line: Finite
    sample: Finite
    lon: Longitude
    lat: Latitude
    height_m: Height | None = Field(
        None, description="Above the ellipsoid; by default that of the terrain of a reference."
    )
    sigma_m: tuple[Sigma | None, Sigma | None] | None = Field(
        None, description="Of its ground: horizontal and up (1 sigma); null for that of all marks."
    )
    check: bool = Field(False, description="Whether it is a check point, held out of the adjustment.")


class AskedPlace(_Body):
    """A place in the image, `line` and `sample`, or on the ground, `lon` and `lat`."""

    line: Finite | None = None
    sample: Finite | None = None
    lon: Longitude | None = None
    lat: Latitude | None = None
    height_m: Height | None = Field(
        None, description="Above the ellipsoid; by default that of the terrain, else of the marks."
    )


class SetMarks(_Body):
    """Marks that are being set, and what is asked of them."""

    marks: list[Mark] = Field(default_factory=list, max_length=MOST_MARKS)
    places: list[AskedPlace] = Field(
        default_factory=list,
        max_length=MOST_PLACES,
        description="Places that the adjusted model brings onto the ground, or into the image.",
    )
    sigma_m: Sigmas | None = Field(
        None, description="Of ground whose mark states none: horizontal and up; by default one pixel."
    )
    mark_sigma_px: Sigma | None = Field(None, description="Of the picks; by default 0.5.")
    frame_sigma_m: Sigmas | None = Field(
        None, description="Error on the Earth that all ground shares: horizontal and up."
    )


@router.post("/jobs/{job_id}/marks")
def adjust_marks(
    *, job_id: JobId, body: SetMarks, installation: InstallationDep, caller: Registrar
) -> models.AdjustedMarks:
    """Adjust the model that a job `read-model` read on marks, and return their residuals.

    Nothing is stored. The result is that of `register-scene` with the method `marks`, whose file of
    marks has the same marks.
    """
    with installation.database.reading() as connection:
        job = jobs.visible_job(connection, caller, job_id)
    scene = marking.model_of_job(installation.storage, job)
    adjusted = marking.adjust_set_marks(
        scene,
        [marking.SetMark(**dict(mark)) for mark in body.marks],
        [_place(place, number) for number, place in enumerate(body.places)],
        marking.heights_of_store(installation.database, installation.settings, scene),
        PointStatements(
            sigma_m=body.sigma_m,
            frame_sigma_m=body.frame_sigma_m,
            mark_sigma_px=body.mark_sigma_px,
        ),
    )
    return _reply(adjusted)


def _place(place: AskedPlace, number: int) -> marking.Place:
    """A place of the use case.

    Raises:
        InputError: it is neither in the image nor on the ground, or both.
    """
    in_image = [value is not None for value in (place.line, place.sample)]
    on_ground = [value is not None for value in (place.lon, place.lat)]
    if in_image + on_ground not in ([True, True, False, False], [False, False, True, True]):
        raise InputError(f"body.places.{number}: line and sample expected, or lon and lat")
    return marking.Place(**dict(place))


def _reply(adjusted: marking.AdjustedMarks) -> models.AdjustedMarks:
    registration = adjusted.registration
    stated: dict[str, Any] = {}
    if registration is not None:
        stated = accuracy_document(registration.qualification.accuracy)
    report = None if registration is None else registration.marks
    return models.AdjustedMarks(
        marks=[*_used(adjusted), *map(_checked, adjusted.checks)],
        verdict=None if registration is None else registration.qualification.verdict,
        relative_to_control_points=stated_accuracy(stated.get("relative_to_control_points")),
        on_the_earth=stated_accuracy(stated.get("on_the_earth")),
        words=[] if report is None else list(report.words),
        next_mark=None if adjusted.next_place is None else _followed(adjusted.next_place),
        places=[_followed(place) for place in adjusted.places],
        terrain=adjusted.terrain,
    )


def _used(adjusted: marking.AdjustedMarks) -> list[models.AdjustedMark]:
    """The marks of the adjustment."""
    if adjusted.registration is None:
        return []
    off_m = np.hypot(*adjusted.registration.measures.residual_m.T).tolist()
    return [
        models.AdjustedMark(
            name=mark.name,
            line=mark.line,
            sample=mark.sample,
            lon=mark.lon,
            lat=mark.lat,
            height_m=mark.height_m,
            sigma_m=_numbers(mark.sigma_m),
            sigma_px=mark.sigma_px,
            residual_px=_numbers(mark.residual_px),
            residual_m=_number(residual_m),
            left_out_px=_numbers(mark.left_out_px),
            status=mark.status,
            note=mark.note,
        )
        for mark, residual_m in zip(adjusted.results, off_m, strict=True)
    ]


def _checked(checked: marking.CheckedMark) -> models.AdjustedMark:
    mark = checked.mark
    return models.AdjustedMark(
        name=mark.name,
        line=mark.line,
        sample=mark.sample,
        lon=mark.lon,
        lat=mark.lat,
        height_m=_number(checked.height_m),
        sigma_m=_numbers(checked.sigma_m),
        sigma_px=_number(checked.sigma_px),
        residual_px=_numbers(checked.residual_px),
        residual_m=_number(checked.residual_m),
        left_out_px=_numbers(checked.residual_px),
        status="check",
        note="",
    )


def _followed(place: marking.FollowedPlace) -> models.PlaceOfMarks:
    numbers = {
        name: _number(getattr(place, name))
        for name in ("line", "sample", "lon", "lat", "height_m", "sigma_px")
    }
    return models.PlaceOfMarks(**numbers, is_height_known=place.is_height_known)


def _number(value: float) -> float | None:
    """A number for JSON; null for what is unknown."""
    return float(value) if math.isfinite(value) else None


def _numbers(values: Any) -> list[float | None]:
    return [_number(value) for value in values.tolist()]
