-- name: uploaded_bytes
-- Bytes of a token's images (those still on their way count as uploads), of the files beside them, and of
-- its unfinished uploads.
select (select coalesce(sum(size_bytes), 0) from scene s
        where owner = :owner and state <> 'removed'
            and not exists (select from upload u
                            where u.scene_id = s.id and u.purpose = 'image' and u.finished_at is null))
    + (select coalesce(sum((beside.value->>'size_bytes')::bigint), 0)
       from scene s, jsonb_each(s.models) beside
       where owner = :owner and state <> 'removed')
    + (select coalesce(sum(size_bytes), 0) from upload
       where owner = :owner and finished_at is null) as used
