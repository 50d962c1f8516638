-- Rows that every store has.

-- 256 random bits, in terms of what PostgreSQL has without an extension.
insert into installation (page_secret) select sha256(decode(replace(
    gen_random_uuid()::text || gen_random_uuid()::text || gen_random_uuid()::text, '-', ''), 'hex'));
insert into uptime default values;
