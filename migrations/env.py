"""Run by Alembic: all missing revisions in one transaction, one upgrade at a time."""

from alembic import context
from sqlalchemy import create_engine, func, select
from sqlalchemy.pool import NullPool

from amers.app.db import session

UPGRADE_LOCK = 0x616D657273  # "amers"

dsn = context.config.attributes["dsn"]
engine = create_engine("postgresql+psycopg://", creator=lambda: session.connect(dsn), poolclass=NullPool)

with engine.begin() as connection:
    connection.execute(select(func.pg_advisory_xact_lock(UPGRADE_LOCK)))
    context.configure(connection=connection, transactional_ddl=True)
    context.run_migrations()
