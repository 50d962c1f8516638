"""Reference images: scenes are registered on them where there are no points."""

from fastapi import APIRouter

from amers.app.api.deps import Admin, DatabaseDep, Registrar, SettingsDep
from amers.app.api.models.administration import Reference, References
from amers.app.api.routes import CallerRoute
from amers.app.usecases import references
from amers.app.usecases.references import NewReference

router = APIRouter(prefix="/references", tags=["references"], route_class=CallerRoute)


@router.get("")
def list_references(*, database: DatabaseDep, caller: Registrar) -> References:
    """List the reference images by name."""
    with database.reading() as connection:
        rows = references.list_references(connection)
    return References(references=[Reference.model_validate(row) for row in rows])


@router.post("", status_code=201)
def add_reference(
    *, body: NewReference, database: DatabaseDep, settings: SettingsDep, caller: Admin
) -> Reference:
    """Add a reference image that lies below AMERS_REFERENCE_FOLDER."""
    with database.transaction() as connection:
        return Reference.model_validate(references.add_reference(connection, settings, body))


@router.delete("/{name}", status_code=204)
def remove_reference(*, name: str, database: DatabaseDep, caller: Admin) -> None:
    """Remove a reference image from the list; its files are not touched."""
    with database.transaction() as connection:
        references.remove_reference(connection, name)
