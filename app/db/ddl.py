"""The script that creates the store: functions, tables, indexes, triggers and first rows.

`python -m amers.app.db.ddl` prints it. A release keeps the script in a migration, which no later change
of the schema touches; `tests/app/test_schema.py` compares a migrated database with the schema.
"""

from collections.abc import Iterator

from sqlalchemy.schema import CreateIndex, CreateTable, DDLElement

from amers.app.db.schema import metadata
from amers.app.db.sql_files import sql_file
from amers.app.db.statements import DIALECT

EXTENSION = "create extension if not exists postgis;\n"


def table_statements() -> Iterator[str]:
    """The statements that create the tables and indexes; a table comes before those that refer to it."""
    for table in metadata.sorted_tables:
        yield _ddl(CreateTable(table))
        for index in sorted(table.indexes, key=lambda index: index.name or ""):
            yield _ddl(CreateIndex(index))


def store_script() -> str:
    """The whole script, to run in one transaction on an empty database."""
    tables = "\n".join(f"{statement};" for statement in table_statements())
    parts = (
        EXTENSION,
        sql_file("functions.sql"),
        f"{tables}\n",
        sql_file("triggers.sql"),
        sql_file("first_rows.sql"),
    )
    return "\n".join(parts)


def _ddl(element: DDLElement) -> str:
    lines = str(element.compile(dialect=DIALECT)).strip().splitlines()
    return "\n".join(line.replace("\t", "    ").rstrip() for line in lines)


if __name__ == "__main__":
    print(store_script(), end="")
