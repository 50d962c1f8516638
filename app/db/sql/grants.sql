-- Let the reading role read all tables, those of later migrations too.
-- Roles belong to the cluster and not to the database: this is no migration, and a restore runs it again.
-- Where the owner of the database may not create roles and nobody has made the role, requests are read as
-- the owner, still read-only.
do $$ begin
    if not exists (select from pg_roles where rolname = 'amers_reader') then
        begin
            create role amers_reader nologin;
        exception when duplicate_object or unique_violation then null;
        end;
    end if;
    if not pg_has_role('amers_reader', 'member') then
        execute format('grant amers_reader to %I', current_user);
    end if;
    execute format('grant usage on schema %I to amers_reader', current_schema());
    execute format('grant select on all tables in schema %I to amers_reader', current_schema());
    execute format(
        'alter default privileges in schema %I grant select on tables to amers_reader', current_schema());
exception when insufficient_privilege then
    raise warning using message = format(
        'requests are read, in read-only transactions, with the rights of %1$I, because it may not use the '
        'role amers_reader: let a superuser run `create role amers_reader nologin` if there is none, and '
        '`grant amers_reader to %1$I`, then run `amers db upgrade`', current_user);
end $$;
