"""A job registers one scene or several: a registration is known by its job and its scene.

It locks the table of registrations while a unique index of it is built: a second for a million of them.
Points, measures and jobs are not touched. On the way back, registrations of a job that made several lose
their job; they and their measures stay.
"""

from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

UPGRADE = """
alter table registration add unique (job_id, scene_id);
alter table registration drop constraint registration_job_id_key
"""

DOWNGRADE = """
update registration r set job_id = null
    where exists (select from registration o where o.job_id = r.job_id and o.id <> r.id);
alter table registration add unique (job_id);
alter table registration drop constraint registration_job_id_scene_id_key
"""


def upgrade() -> None:
    op.execute(UPGRADE)


def downgrade() -> None:
    op.execute(DOWNGRADE)
