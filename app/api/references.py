"""Reference images that scenes are registered on where there are no points."""

from dataclasses import asdict
from typing import Any

from fastapi import APIRouter
from fastapi.encoders import jsonable_encoder

from app.api.deps import Admin, DatabaseDep, Registrar, SettingsDep
from app.db.references import ReferenceRow
from app.usecases import references
from app.usecases.references import NewReference

router = APIRouter(prefix="/references", tags=["references"])


@router.get("")
def list_references(database: DatabaseDep, caller: Registrar) -> dict[str, Any]:
    """The reference images, by name."""
    with database.reading() as connection:
        return {"references": [_told(row) for row in references.list_references(connection)]}


@router.post("", status_code=201)
def add_reference(
    body: NewReference, database: DatabaseDep, settings: SettingsDep, caller: Admin
) -> dict[str, Any]:
    """Let scenes be registered on a reference image below AMERS_REFERENCE_FOLDER."""
    with database.transaction() as connection:
        return _told(references.add_reference(connection, settings, body))


@router.delete("/{name}", status_code=204)
def remove_reference(name: str, database: DatabaseDep, caller: Admin) -> None:
    """Use a reference image no longer; its files stay where they are."""
    with database.transaction() as connection:
        references.remove_reference(connection, name)


def _told(row: ReferenceRow) -> dict[str, Any]:
    told: dict[str, Any] = jsonable_encoder(asdict(row))
    return told
