-- name: installation
-- Figures of the whole installation, in one row.
select
    (select coalesce(extract(epoch from clock_timestamp() - min(created_at)), 0)
        from job where state = 'accepted')::float8 as oldest_waiting_s,
    (select count(*) from job where state = 'accepted') as queue,
    (select coalesce(sum(n_points - n_unserved), 0) from block
        where state = 'published')::bigint as points,
    (select coalesce(sum(n_chips * case dtype when 'uint16' then 2 else 1 end), 0) * :chip_px
        from (select distinct storage_key, n_chips, dtype from chip_file) file)::bigint as chip_bytes,
    (select count(*) from damaged_file) as damaged_files,
    pg_database_size(current_database()) as database_bytes
