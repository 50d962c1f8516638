"""What registrations say of points, and what an administrator makes of it."""

from dataclasses import asdict
from typing import Any

from fastapi import APIRouter
from fastapi.encoders import jsonable_encoder
from pydantic import BaseModel, ConfigDict

from app.api.deps import Admin, DatabaseDep
from app.db.history import PointHistory
from app.usecases import history

router = APIRouter(prefix="/points", tags=["points"])


class Suspension(BaseModel):
    """Why a point is suspended."""

    model_config = ConfigDict(extra="forbid")

    because: str


@router.post("/{point_id}/suspend")
def suspend(point_id: int, body: Suspension, database: DatabaseDep, caller: Admin) -> dict[str, Any]:
    """Serve a point no longer; what is proposed for it is in the collection `point-history`."""
    with database.transaction() as connection:
        return _told(history.suspend_point(connection, point_id, body.because))


@router.post("/{point_id}/reinstate")
def reinstate(point_id: int, database: DatabaseDep, caller: Admin) -> dict[str, Any]:
    """Serve a suspended point again; its history begins anew."""
    with database.transaction() as connection:
        return _told(history.reinstate_point(connection, point_id))


def _told(found: PointHistory) -> dict[str, Any]:
    told: dict[str, Any] = jsonable_encoder(asdict(found))
    return told
