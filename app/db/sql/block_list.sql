-- All blocks, the newest first, with what their accuracy follows from (app/db/block_list.py). Where a document
-- states its frame stands in app/db/blocks.py for SQLAlchemy, too.
select number, id, version, title, state, priority, n_points, n_unserved, n_views, created_at,
    state_changed_at,
    cast(quality #>> '{sigma_horizontal_m,median}' as double precision) as sigma_horizontal_m,
    cast(quality #>> '{sigma_up_m,median}' as double precision) as sigma_up_m,
    metadata -> 'amers:frame' as frame,
    cast(jsonb_path_query_first(
        metadata, '$."amers:accuracy"."absolute"[*] ? (@.name == "frame_sigma_m").value'
    ) as double precision) as frame_sigma_m,
    array[st_xmin(extent), st_ymin(extent), st_xmax(extent), st_ymax(extent)] as box,
    metadata #> '{amers:provenance,options,renewal}' as renewal
from block order by number desc
