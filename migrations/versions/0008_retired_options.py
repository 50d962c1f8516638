"""Inputs of jobs without options that no longer exist: a job of an earlier release runs as before.

It rewrites the rows of `job` that have such options, and locks each of them until its end: some
thousand rows take less than a second, however many points the store has. The options are gone for
good: an older release reads their absence as their default.
"""

from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None

UPGRADE = """
update job
set inputs = inputs
    #- '{options,adjustment,slope_px}'
    #- '{options,qualification,good_displacement_of_points}'
    #- '{options,qualification,usable_displacement_of_points}'
    #- '{options,qualification,good_ce90_of_points}'
    #- '{options,qualification,usable_ce90_of_points}'
where inputs #> '{options,adjustment}' ? 'slope_px'
    or inputs #> '{options,qualification}' ?| array[
        'good_displacement_of_points', 'usable_displacement_of_points',
        'good_ce90_of_points', 'usable_ce90_of_points'
    ]
"""


def upgrade() -> None:
    op.execute(UPGRADE)


def downgrade() -> None:
    pass
