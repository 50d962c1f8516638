"""What registrations did with each point and view, and what that says of them.

Every registration leaves a row for each point it could see (`measure`) and each view it tried
(`view_measure`). What they come to is kept beside them (`point_history`, `view_history`), added to in
the transaction of the registration: reading the health of a thousand points must not read the rows of a
thousand registrations, and old rows can be taken away without the health forgetting them.

A scene says what it has to say of a point once: `counted` is the one registration of a scene
(`scene_key`) that was added. Registrations before this revision were not.

A point that an administrator has suspended is not served; `point.suspended_at` says so.
"""

from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

REGISTRATION = """
alter table registration
    add column scene_key text,
    add column counted boolean not null default false
"""

MEASURE = """
alter table measure
    add column residual_east_m real,
    add column residual_north_m real
"""

VIEW_MEASURE = """
create table view_measure (
    registration_id uuid not null references registration on delete cascade,
    point_id bigint not null,
    view smallint not null,
    agreed boolean not null,
    reason text not null,
    score real,
    primary key (registration_id, point_id, view)
)
"""

POINT_HISTORY = """
create table point_history (
    point_id bigint primary key,
    attempts int not null default 0,
    successes int not null default 0,
    expected double precision not null default 0,
    matched int not null default 0,
    sum_residual_px double precision not null default 0,
    sum_east_m double precision not null default 0,
    sum_north_m double precision not null default 0,
    last_attempt timestamptz,
    last_success timestamptz
)
"""

VIEW_HISTORY = """
create table view_history (
    point_id bigint not null,
    view smallint not null,
    attempts int not null,
    successes int not null,
    expected double precision not null,
    primary key (point_id, view)
)
"""

POINT = "alter table point add column suspended_at timestamptz, add column suspended_because text"


def upgrade() -> None:
    for statement in (
        REGISTRATION,
        "create unique index registration_counted on registration (scene_key) where counted",
        MEASURE,
        VIEW_MEASURE,
        POINT_HISTORY,
        VIEW_HISTORY,
        POINT,
        "create index point_suspended on point (id) where suspended_at is not null",
        """create trigger point_changes after update of suspended_at on point for each row
           execute function record_change('suspended_at', 'suspended_because')""",
    ):
        op.execute(statement)


def downgrade() -> None:
    for statement in (
        "drop trigger point_changes on point",
        "alter table point drop column suspended_at, drop column suspended_because",
        "drop table view_measure, point_history, view_history",
        "alter table measure drop column residual_east_m, drop column residual_north_m",
        "alter table registration drop column scene_key, drop column counted",
    ):
        op.execute(statement)
