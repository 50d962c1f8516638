"""The files of `app/db/sql`, for the driver or for SQLAlchemy."""

from importlib import resources


def sql_file(name: str) -> str:
    """The text of a file of `app/db/sql`."""
    return resources.files("amers.app.db").joinpath("sql", name).read_text()
