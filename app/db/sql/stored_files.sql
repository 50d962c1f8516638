-- name: named_files
-- The files of the storage that rows name, one row each: kind, size and SHA-256, null where unknown. The
-- key of a file of chips contains its SHA-256; two blocks may share a file. With keys: only these.
with named as (
    select storage_key, 'chips' as kind,
        max(n_chips * case dtype when 'uint8' then 10201 else 20402 end)::bigint as size_bytes,
        substring(storage_key from '^chips/([0-9a-f]{64})\.npy$') as sha256
    from chip_file group by storage_key
    union all
    select file_key, 'scene image', size_bytes, sha256
    from scene where state = 'uploaded' and file_key is not null
    union all
    select 'scenes/' || scene.id || '/' || file.name, 'side file',
        (file.content->>'size_bytes')::bigint, file.content->>'sha256'
    from scene cross join jsonb_each(models) as file (name, content)
    where state <> 'removed' and reference is null
    union all
    select file_key, 'upload archive', size_bytes, sha256
    from upload where file_key is not null
    union all
    select file.key, 'result', result_file.size_bytes, result_file.sha256
    from job cross join jsonb_each_text(results->'files') as file (name, key)
        left join result_file on result_file.storage_key = file.key
    where state in ('successful', 'failed') and results_removed_at is null and results ? 'files'
)
select * from named
where cast(:keys as text[]) is null or storage_key = any(cast(:keys as text[]))
order by storage_key

-- name: points_of_chips
-- The points with chips in a file, by id, each with its rows of the file.
select p.id, p.chip_row, p.chip_count
from chip_file f join point p on p.id >= f.block_number::bigint << :id_bits
    and p.id < (f.block_number + 1)::bigint << :id_bits and p.chip_file = f.id
where f.storage_key = :storage_key
order by p.id

-- name: folders_in_progress
-- Folders of the storage in which files without a row may lie for a moment: they are being written.
select 'scenes/' || id as folder from scene where state = 'uploading'
union
select 'scenes/' || scene_id from upload where finished_at is null and scene_id is not null
union
select 'uploads/' || id from upload where finished_at is null
union
select 'results/' || id || '/' || attempt from job where state = 'running'
