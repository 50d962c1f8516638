"""The ledger of the storage: sizes of side files and of results, and the quota over both.

Jobs can be removed, and the oldest rows of the audit: audit rows name the owner of their job themselves.
"""

from pathlib import Path

from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

FORWARD = Path(__file__).with_suffix(".sql")
BACK = Path(__file__).with_name("0006_storage_ledger_down.sql")


def upgrade() -> None:
    _run(FORWARD.read_text())


def downgrade() -> None:
    _run(BACK.read_text())


def _run(script: str) -> None:
    """Run several statements as they are: percent signs and colons have no meaning to the driver."""
    connection = op.get_bind().connection.driver_connection
    assert connection is not None
    connection.execute(script)
