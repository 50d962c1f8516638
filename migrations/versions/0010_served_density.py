"""Density of the points that are served: cells know how many of theirs are superseded or suspended.

Kept by each publication, withdrawal and suspension, in the transaction that decides what is served.
"""

from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

# Columns and rows as in revision 0004; a cell that nothing is taken from any more goes back to 0.
COUNT_UNSERVED = """
create function count_unserved_cells() returns void language sql as $$
    with lowest as (
        select least(floor((st_x(geom) + 180) * 10)::int, 3599) as col,
            least(floor((st_y(geom) + 90) * 10)::int, 1799) as row, count(*) as n
        from point where (superseded_by is not null or suspended_at is not null)
            and block_number in (select number from block where state = 'published') group by 1, 2
    ), counted as (
        select (level << 24) + (row >> level) * 3600 + (col >> level) as id, sum(n)::bigint as n
        from lowest, generate_series(0, 6) level group by 1
    ), changed as (
        select d.id, coalesce(c.n, 0) as n from density_cell d left join counted c using (id)
        where d.n_unserved <> coalesce(c.n, 0) order by d.id
    )
    update density_cell d set n_unserved = changed.n from changed where d.id = changed.id
$$
"""

UP = (
    "alter table density_cell add column n_unserved bigint not null default 0",
    COUNT_UNSERVED,
    "select count_unserved_cells()",
)
DOWN = (
    "drop function count_unserved_cells()",
    "alter table density_cell drop column n_unserved",
)


def upgrade() -> None:
    for statement in UP:
        op.execute(statement)


def downgrade() -> None:
    for statement in DOWN:
        op.execute(statement)
