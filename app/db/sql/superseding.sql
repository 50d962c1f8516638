-- Several blocks over one place: which of two points is served (app/db/superseding.py).

-- name: supersede
-- Write to points of a block, the losers `l`, which point `w` of a winning block supersedes each, or none:
-- of the first block in the order of `winners` that has a point within `metres`, the nearest one.
-- Two restrictions can be null, and the planner then drops them: `part`, where the losers lie, and
-- `lost_first` and `lost_end`, the ids of points that superseded them until now.
-- Distances are on a sphere: 0.5 % of ten metres do not matter. Materialised: otherwise each winner is
-- looked for twice, for the comparison and for its value.
with decided as materialized (
    select l.id, (
        select w.id
        from point w, lateral (select st_distancesphere(w.geom, l.geom) as metres) apart
        where w.geom && st_expand(
                l.geom, :degrees / greatest(cos(radians(st_y(l.geom))), 0.001), :degrees)
            and w.block_number = any(cast(:winners as int[])) and apart.metres <= :metres
        order by array_position(cast(:winners as int[]), w.block_number), apart.metres, w.id limit 1
    ) as winner
    from point l
    where l.id >= :first and l.id < :end
        and (cast(:part as geometry) is null or l.geom && st_setsrid(cast(:part as geometry), 4979))
        and (cast(:lost_first as bigint) is null
            or l.superseded_by >= :lost_first and l.superseded_by < :lost_end)
)
update point set superseded_by = decided.winner
from decided where point.id = decided.id and point.superseded_by is distinct from decided.winner

-- name: release
-- Let no point of a block be superseded.
update point set superseded_by = null
where id >= :first and id < :end and superseded_by is not null

-- name: count_unserved
-- Count again the points of each block that are superseded or suspended.
update block set n_unserved = coalesce(counted.n, 0)
from block b left join (
    select cast(id >> :id_bits as int) as number, count(*) as n
    from point where superseded_by is not null or suspended_at is not null
    group by 1
) counted using (number)
where block.number = b.number and block.n_unserved <> coalesce(counted.n, 0)
