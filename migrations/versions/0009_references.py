"""Reference images, on which scenes are registered where there are no points, and places found on them.

The images stay where they lie, below a folder of the settings. A place is ground that a scene was found
by; the next scene of the same ground is looked for there first.
"""

from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

REFERENCE_IMAGE = """
create table reference_image (
    id int generated always as identity primary key,
    name text not null unique,
    image text not null,
    dem text,
    vertical text,
    geoid text,
    sigma_m real check (sigma_m > 0),
    gsd_m double precision not null check (gsd_m > 0),
    footprint geometry(Polygon, 4326) not null,
    created_at timestamptz not null default now()
)
"""

HOMOLOGOUS_PLACE = """
create table homologous_place (
    id bigint generated always as identity primary key,
    reference_id int not null references reference_image on delete cascade,
    geom geometry(PointZ, 4979) not null,
    tried int not null check (tried > 0),
    found int not null check (found between 0 and tried),
    last_found_at timestamptz not null
)
"""


def upgrade() -> None:
    for statement in (
        REFERENCE_IMAGE,
        HOMOLOGOUS_PLACE,
        "create index homologous_place_geom on homologous_place using gist (geom)",
        "create index homologous_place_reference on homologous_place (reference_id)",
        """create trigger reference_image_changes after insert or update or delete on reference_image
           for each row execute function record_change(
               'name', 'image', 'dem', 'vertical', 'geoid', 'sigma_m')""",
    ):
        op.execute(statement)


def downgrade() -> None:
    op.execute("drop table homologous_place, reference_image")
