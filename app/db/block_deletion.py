"""Deletion of a block: its points with their views and histories, its images and its files of chips."""

from sqlalchemy import delete, select

from amers.app.db.blocks import ID_BITS
from amers.app.db.engine import Connection
from amers.app.db.schema import block, chip_file, point, point_history, view, view_history


def delete_block(connection: Connection, number: int) -> None:
    """Delete a block that is not published, with all rows that belong to it.

    What registrations measured at its points stays with the registrations: no later point gets the ids
    of these points, because no later block gets the number of this one.
    """
    ids = {view: view.c.point_id, view_history: view_history.c.point_id}
    ids |= {point_history: point_history.c.point_id, point: point.c.id}
    first, end = number << ID_BITS, (number + 1) << ID_BITS
    for table, column in ids.items():
        connection.execute(delete(table).where(column >= first, column < end))
    connection.execute(delete(chip_file).where(chip_file.c.block_number == number))
    connection.execute(delete(block).where(block.c.number == number))


def chip_keys(connection: Connection, number: int) -> set[str]:
    """The keys in the storage of the files of chips of a block; other blocks may have the same files."""
    statement = select(chip_file.c.storage_key).where(chip_file.c.block_number == number)
    return set(connection.scalars(statement))
