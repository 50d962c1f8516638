-- Nobody logs in as this superuser by network: without a password, the server refuses all of them.
-- On the server's machine, or in its container, `psql --username postgres` works as before.
alter role current_user password null;
