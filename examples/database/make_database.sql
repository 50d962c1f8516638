-- Makes what a superuser makes for Amers: role, database, PostGIS. Once, on PostgreSQL 15 or later:
--   psql --set=password_file=FILE --file=make_database.sql "host=… user=postgres dbname=postgres"
-- FILE has the password of the new role in one line, as AMERS_DATABASE_PASSWORD_FILE needs it.
-- Others: --set=role=… --set=database=… (both `amers`), --set=postgis_schema=… (`public`).
\set ON_ERROR_STOP on
\if :{?password_file}
\else
\set password_file /run/secrets/database_password
\endif
\if :{?role}
\else
\set role amers
\endif
\if :{?database}
\else
\set database amers
\endif
\if :{?postgis_schema}
\else
\set postgis_schema public
\endif
\set password `cat :'password_file'`
select length(:'password') > 0 as has_password \gset
\if :has_password
\else
do $$ begin
    raise exception 'the file of the password cannot be read or is empty: name it by --set=password_file=FILE';
end $$;
\endif

-- No statement with the password stands in the log of the server.
set log_statement = 'none';
set log_min_duration_statement = -1;
set log_min_error_statement = 'panic';
create role :"role" login nosuperuser nocreatedb nocreaterole password :'password';
\unset password

-- Requests are read with the rights of this role, which can do nothing else.
select count(*) = 0 as is_first from pg_roles where rolname = 'amers_reader' \gset
\if :is_first
create role amers_reader nologin;
\endif
grant amers_reader to :"role";

create database :"database" owner :"role" template template0 encoding 'UTF8';
\connect :"database"
create schema if not exists :"postgis_schema";
create extension postgis schema :"postgis_schema";
select :'postgis_schema' <> 'public' as is_elsewhere \gset
\if :is_elsewhere
grant usage on schema :"postgis_schema" to :"role", amers_reader;
\endif
