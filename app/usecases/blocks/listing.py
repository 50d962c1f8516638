"""List the blocks of the store with their accuracy, of the driver's rows alone."""

from amers.app.db import block_list
from amers.app.db.block_list import BlockSummary
from amers.app.db.session import DriverConnection
from amers.services.quality.accuracy_statement import AccuracyStatement, median_accuracy


def list_blocks(connection: DriverConnection) -> list[tuple[BlockSummary, AccuracyStatement]]:
    """All blocks, the newest first, each with the accuracy of its median point."""
    return [
        (entry.block, median_accuracy(entry.sigma_horizontal_m, entry.sigma_up_m, entry.frame))
        for entry in block_list.list_blocks(connection)
    ]
