"""Settings of the installation, from the environment (prefix `AMERS_`), which nothing else reads."""

import os
from pathlib import Path

from pydantic import Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from app.errors import InputError

GIBIBYTE = 1 << 30
MEBIBYTE = 1 << 20


def default_data_folder() -> Path:
    """Where Amers keeps its data when nobody says otherwise."""
    if os.geteuid() == 0:
        return Path("/var/lib/amers")
    base = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(base) / "amers"


class Settings(BaseSettings):
    """Infrastructure of one installation; options of algorithms live beside the algorithms.

    Attributes:
        database_url: PostgreSQL with PostGIS, `postgresql://user:password@host/name`; none means a
            private cluster in the data folder.
        data_folder: the private cluster and the stored files.
        host, port: where the API listens.
        upload_limit_bytes: largest scene that can be uploaded.
        body_limit_bytes: largest body of every other request.
        public_points: points and chips can be read without a token.
        pool_size: most connections one API process opens for reading, and again for writing.
        read_timeout_seconds: longest time the database may spend on one statement of a reading request.
        job_memory_bytes, job_seconds: what one job may use before it is stopped.
        lease_seconds: how long a job waits for a silent worker before another takes it over.
        ingest_folder: holds the block folders that may be ingested through the API; none: not at all.
    """

    model_config = SettingsConfigDict(env_prefix="AMERS_", frozen=True)

    database_url: SecretStr | None = None
    data_folder: Path = Field(default_factory=default_data_folder)
    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=1, le=65535)
    upload_limit_bytes: int = Field(default=32 * GIBIBYTE, ge=1)
    body_limit_bytes: int = Field(default=MEBIBYTE, ge=1)
    public_points: bool = False
    pool_size: int = Field(default=8, ge=1, le=100)
    read_timeout_seconds: float = Field(default=10.0, gt=0)
    job_memory_bytes: int = Field(default=8 * GIBIBYTE, ge=64 * MEBIBYTE)
    job_seconds: float = Field(default=3600.0, gt=0)
    lease_seconds: float = Field(default=30.0, gt=0)
    ingest_folder: Path | None = None

    @field_validator("data_folder")
    @classmethod
    def _absolute(cls, folder: Path) -> Path:
        return folder.expanduser().absolute()


def read_settings() -> Settings:
    """The settings of this process.

    Raises:
        InputError: a variable does not hold what it should; the message names it.
    """
    try:
        return Settings()
    except ValidationError as error:
        wrong = "; ".join(
            f"AMERS_{'_'.join(str(part) for part in item['loc']).upper()}: {item['msg']}"
            for item in error.errors()
        )
        raise InputError(f"wrong setting: {wrong}") from None
