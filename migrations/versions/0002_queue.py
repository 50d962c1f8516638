"""The tables of the queue (procrastinate), so that one command makes the whole store.

The script is procrastinate's own, of the installed version. An upgrade of procrastinate that changes its
schema needs a revision with the statements of that release.
"""

from alembic import op
from procrastinate.schema import SchemaManager

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

DROP_EVERYTHING_NAMED_PROCRASTINATE = """
do $$
declare name text;
begin
    for name in
        select tablename from pg_tables where schemaname = 'public' and tablename like 'procrastinate%'
    loop
        execute format('drop table public.%I cascade', name);
    end loop;
    for name in select p.oid::regprocedure::text from pg_proc p where proname like 'procrastinate%' loop
        execute 'drop function ' || name || ' cascade';
    end loop;
    for name in
        select typname from pg_type where typname like 'procrastinate%' and typtype in ('e', 'c')
    loop
        execute format('drop type public.%I cascade', name);
    end loop;
end $$
"""


def upgrade() -> None:
    _run(SchemaManager.get_schema())


def downgrade() -> None:
    _run(DROP_EVERYTHING_NAMED_PROCRASTINATE)


def _run(script: str) -> None:
    """Run several statements as they are: percent signs and colons have no meaning to the driver."""
    connection = op.get_bind().connection.driver_connection
    assert connection is not None
    connection.execute(script)
