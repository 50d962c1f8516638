"""The identity of the installation, and the generation of its storage."""

from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

UPGRADE = """
alter table installation
    add column id uuid not null default gen_random_uuid(),
    add column storage_generation bigint not null default 0
"""
DOWNGRADE = "alter table installation drop column id, drop column storage_generation"


def upgrade() -> None:
    op.execute(UPGRADE)


def downgrade() -> None:
    op.execute(DOWNGRADE)
