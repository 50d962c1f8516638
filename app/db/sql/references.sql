-- name: places_inside
-- Places of a reference image in an area, the most successful first.
select id, st_x(geom) as lon, st_y(geom) as lat, st_z(geom) as h from reference_point
where reference_id = :reference_id and st_intersects(geom, st_setsrid(st_geomfromwkb(:area), 4979))
    and not (:worthwhile and attempts >= :few_attempts and 2 * successes < attempts)
order by successes::real / attempts desc, successes desc, id

-- name: count_places
-- Rows are locked in the order of their ids, so that two registrations do not deadlock.
update reference_point p set attempts = attempts + 1, successes = successes + new.success::int,
    last_success_at = case when new.success then now() else last_success_at end
from (select * from unnest(cast(:ids as bigint[]), cast(:successes as bool[])) as n(id, success)
      order by id) new
where p.id = new.id
