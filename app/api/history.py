"""Suspension and reinstatement of points, for administrators."""

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from amers.app.api.deps import Admin, DatabaseDep
from amers.app.api.models.features import PointHistoryRecord
from amers.app.api.paths import PathNumber
from amers.app.api.routes import CallerRoute
from amers.app.usecases import history

router = APIRouter(prefix="/points", tags=["points"], route_class=CallerRoute)


class Suspension(BaseModel):
    """The suspension of a point."""

    model_config = ConfigDict(extra="forbid")

    because: str = Field(description="Reason of the suspension.")


@router.post("/{point_id}/suspend")
def suspend(
    *, point_id: PathNumber, body: Suspension, database: DatabaseDep, caller: Admin
) -> PointHistoryRecord:
    """Suspend a point: it is no longer served. The collection `point-history` has the proposals."""
    with database.transaction() as connection:
        record = history.suspend_point(connection, point_id, body.because)
    return PointHistoryRecord.model_validate(record)


@router.post("/{point_id}/reinstate")
def reinstate(*, point_id: PathNumber, database: DatabaseDep, caller: Admin) -> PointHistoryRecord:
    """Serve a suspended point again; its history starts anew."""
    with database.transaction() as connection:
        record = history.reinstate_point(connection, point_id)
    return PointHistoryRecord.model_validate(record)
