"""The accuracy that every place states: of blocks in columns, and of the heights of reference images.

CE90 and LE90 of the median point of a block, in the frame of the block and on the Earth; null where
the frame is not stated. The blocks present get theirs from their quality and their documents. It locks
the tables of blocks and reference images for the time that reading the documents of all blocks takes,
some milliseconds each; the points are not touched.
"""

from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

FILL = """
-- ce90: of normal laws in the plane of standard deviations 1 and k/128, k from 0 to 128.
with stated as (
    select number,
        (quality #>> '{sigma_horizontal_m,median}')::double precision ^ 2 as horizontal,
        (quality #>> '{sigma_up_m,median}')::double precision ^ 2 as up,
        metadata #> '{amers:frame,covariance_m2}' as frame,
        (jsonb_path_query_first(metadata, '$."amers:accuracy"."absolute"[*]
            ? (@.name == "frame_sigma_m").value')::double precision) ^ 2 as frame_variance
    from block
), variances as (
    select number, horizontal, up,
        horizontal + case when frame is null then frame_variance
            else (frame #>> '{0,0}')::double precision end as east,
        horizontal + case when frame is null then frame_variance
            else (frame #>> '{1,1}')::double precision end as north,
        case when frame is null then 0 else (frame #>> '{0,1}')::double precision end as east_north,
        up + (frame #>> '{2,2}')::double precision as earth_up
    from stated
), axes as (
    select *, (east + north) / 2 + sqrt(((east - north) / 2) ^ 2 + east_north ^ 2) as large,
        (east + north) / 2 - sqrt(((east - north) / 2) ^ 2 + east_north ^ 2) as small
    from variances
), places as (
    select *, 128 * sqrt(greatest(small, 0) / nullif(large, 0)) as place from axes
), tabulated as (
    select *, least(floor(place)::integer, 127) as node, array[
        1.64485, 1.64487, 1.64493, 1.64502, 1.64515, 1.64532, 1.64552, 1.64576, 1.64604, 1.64636,
        1.64672, 1.64711, 1.64754, 1.64801, 1.64852, 1.64906, 1.64965, 1.65027, 1.65094, 1.65164,
        1.65239, 1.65317, 1.65400, 1.65486, 1.65577, 1.65672, 1.65772, 1.65875, 1.65983, 1.66096,
        1.66213, 1.66334, 1.66461, 1.66591, 1.66727, 1.66868, 1.67013, 1.67164, 1.67319, 1.67480,
        1.67646, 1.67818, 1.67995, 1.68178, 1.68367, 1.68562, 1.68763, 1.68971, 1.69185, 1.69407,
        1.69635, 1.69870, 1.70113, 1.70364, 1.70623, 1.70890, 1.71166, 1.71451, 1.71744, 1.72047,
        1.72359, 1.72682, 1.73014, 1.73356, 1.73708, 1.74071, 1.74444, 1.74828, 1.75222, 1.75627,
        1.76043, 1.76469, 1.76907, 1.77354, 1.77813, 1.78282, 1.78761, 1.79251, 1.79751, 1.80261,
        1.80781, 1.81311, 1.81851, 1.82400, 1.82959, 1.83527, 1.84104, 1.84689, 1.85284, 1.85887,
        1.86499, 1.87118, 1.87746, 1.88382, 1.89025, 1.89676, 1.90335, 1.91001, 1.91674, 1.92354,
        1.93040, 1.93734, 1.94434, 1.95140, 1.95853, 1.96572, 1.97298, 1.98029, 1.98766, 1.99508,
        2.00257, 2.01011, 2.01770, 2.02535, 2.03305, 2.04080, 2.04861, 2.05646, 2.06436, 2.07232,
        2.08032, 2.08836, 2.09646, 2.10460, 2.11278, 2.12101, 2.12929, 2.13760, 2.14597
    ] as ce90 from places
)
update block
set relative_ce90_m = 2.145966 * sqrt(horizontal), relative_le90_m = 1.644854 * sqrt(up),
    on_the_earth_ce90_m = sqrt(large)
        * (ce90[node + 1] + (place - node) * (ce90[node + 2] - ce90[node + 1])),
    on_the_earth_le90_m = 1.644854 * sqrt(earth_up)
from tabulated where tabulated.number = block.number
"""

UPGRADE = """
alter table reference_image add column sigma_up_m real check (sigma_up_m > 0);
drop trigger reference_image_changes on reference_image;
create trigger reference_image_changes after insert or update or delete on reference_image
    for each row execute function record_change(
        'name', 'image', 'dem', 'vertical', 'geoid', 'sigma_m', 'sigma_up_m');
alter table block
    add column relative_ce90_m real, add column relative_le90_m real,
    add column on_the_earth_ce90_m real, add column on_the_earth_le90_m real
"""

DOWNGRADE = """
drop trigger reference_image_changes on reference_image;
create trigger reference_image_changes after insert or update or delete on reference_image
    for each row execute function record_change(
        'name', 'image', 'dem', 'vertical', 'geoid', 'sigma_m');
alter table reference_image drop column sigma_up_m;
alter table block
    drop column relative_ce90_m, drop column relative_le90_m,
    drop column on_the_earth_ce90_m, drop column on_the_earth_le90_m
"""


def upgrade() -> None:
    op.execute(UPGRADE)
    op.execute(FILL)


def downgrade() -> None:
    op.execute(DOWNGRADE)
