-- Make the application's role the owner of this database, and of all in schema public but extensions.
-- The superuser of a private cluster runs it once for every database; a second run changes nothing.
-- REASSIGN OWNED refuses what belongs to the first superuser of a cluster, as in clusters of former versions.
create extension if not exists postgis;
do $$
declare
    statement text;
begin
    if not exists (select from pg_roles where rolname = 'amers_app') then
        create role amers_app login;
    end if;
    if not exists (select from pg_roles where rolname = 'amers_reader') then
        create role amers_reader nologin;
    end if;
    grant amers_reader to amers_app;
    -- An archive brings the reference systems that were added to those of PostGIS.
    grant insert on spatial_ref_sys to amers_app;
    for statement in
        with of_extension as (
            select classid, objid from pg_depend where deptype = 'e'
        )
        -- The sequence of a column follows its table.
        select format('alter table %s owner to amers_app', oid::regclass)
        from pg_class c
        where relnamespace = 'public'::regnamespace and relkind in ('r', 'p', 'v', 'm', 'f', 'S')
            and ('pg_class'::regclass, oid) not in (select * from of_extension)
            and not exists (select from pg_depend d where d.classid = 'pg_class'::regclass
                            and d.objid = c.oid and relkind = 'S' and deptype in ('a', 'i'))
        union all
        select format('alter routine %s owner to amers_app', oid::regprocedure)
        from pg_proc
        where pronamespace = 'public'::regnamespace
            and ('pg_proc'::regclass, oid) not in (select * from of_extension)
        union all
        select format('alter type %s owner to amers_app', t.oid::regtype)
        from pg_type t left join pg_class c on c.oid = typrelid
        where typnamespace = 'public'::regnamespace
            and (typtype in ('d', 'e', 'r') or relkind = 'c')
            and ('pg_type'::regclass, t.oid) not in (select * from of_extension)
    loop
        execute statement;
    end loop;
    alter default privileges in schema public revoke select on tables from amers_reader;
    alter default privileges for role amers_app in schema public
        grant select on tables to amers_reader;
    execute format('alter database %I owner to amers_app', current_database());
end $$;
