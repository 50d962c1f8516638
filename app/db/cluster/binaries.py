"""The PostgreSQL binaries of this machine, and the user that runs them."""

import os
import pwd
import re
import shutil
import subprocess
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from amers.app.errors import InputError

INSTALL_HINT = (
    "install PostgreSQL with PostGIS (Debian, Ubuntu: apt-get install postgresql postgresql-postgis), "
    "or set AMERS_DATABASE_URL"
)
USUAL_FOLDERS = (
    "usr/lib/postgresql/*/bin",
    "usr/pgsql-*/bin",
    "usr/local/pgsql/bin",
    "opt/postgresql/*/bin",
)
NEEDED = ("postgres", "initdb", "pg_ctl")


@dataclass(frozen=True)
class Binaries:
    """One PostgreSQL installation that has PostGIS.

    Attributes:
        folder: holds `postgres`, `initdb`, `pg_ctl`.
        version: major version.
    """

    folder: Path
    version: int


@dataclass(frozen=True)
class ServerUser:
    """The operating system user a cluster belongs to."""

    name: str
    uid: int
    gid: int


def find_binaries(version: int | None = None) -> Binaries:
    """The newest PostgreSQL of this machine that has PostGIS.

    Args:
        version: accept only this major version, that of an existing cluster.

    Raises:
        InputError: there is none; the message says what to install.
    """
    found = [binaries for folder in _candidate_folders() if (binaries := _inspect(folder))]
    if not found:
        raise InputError(f"PostgreSQL with PostGIS was not found: {INSTALL_HINT}")
    fitting = [binaries for binaries in found if version in (None, binaries.version)]
    if not fitting:
        present = ", ".join(str(binaries.version) for binaries in found)
        raise InputError(
            f"the data folder was made by PostgreSQL {version}, this machine has {present}: install "
            f"version {version} with its PostGIS, or back up with the old one and restore with the new"
        )
    return max(fitting, key=lambda binaries: binaries.version)


def server_user(folder: Path) -> ServerUser:
    """Who runs the server of a cluster: its owner, as PostgreSQL refuses to run as root.

    Args:
        folder: the folder of the cluster, which may not exist yet.

    Raises:
        InputError: the cluster belongs to somebody else.
    """
    owner = folder.stat().st_uid if folder.exists() else None
    if os.geteuid() != 0:
        if owner not in (None, os.geteuid()):
            raise InputError(
                f"{folder} belongs to user {_user_name(owner or 0)}: "
                "run as that user, or choose another AMERS_DATA_FOLDER"
            )
        return ServerUser(_user_name(os.geteuid()), os.geteuid(), os.getegid())
    if owner:
        return _user(pwd.getpwuid(owner))
    for name in ("postgres", "nobody"):
        try:
            return _user(pwd.getpwnam(name))
        except KeyError:
            continue
    raise InputError(
        "as root, Amers runs PostgreSQL as the user postgres or nobody; this machine has neither"
    )


def run_as(
    user: ServerUser, command: list[str], timeout_s: float = 120.0
) -> subprocess.CompletedProcess[str]:
    """Run a command as the server's user, out of reach of the terminal's Ctrl-C."""
    identity = {"user": user.uid, "group": user.gid, "extra_groups": []} if os.geteuid() == 0 else {}
    done: subprocess.CompletedProcess[str] = subprocess.run(
        command,
        cwd="/",
        env={"PATH": "/usr/bin:/bin", "LC_ALL": "C", "TZ": "UTC"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        start_new_session=True,
        timeout=timeout_s,
        check=False,
        **identity,  # type: ignore[call-overload]
    )
    return done


def _candidate_folders() -> list[Path]:
    folders = [folder for pattern in USUAL_FOLDERS for folder in Path("/").glob(pattern)]
    on_path = shutil.which("postgres")
    if on_path:
        folders.append(Path(on_path).resolve().parent)
    return list(dict.fromkeys(folder.resolve() for folder in folders))


@cache
def _inspect(folder: Path) -> Binaries | None:
    if not all((folder / name).is_file() for name in NEEDED):
        return None
    if not (_share_folder(folder) / "extension" / "postgis.control").is_file():
        return None
    output = subprocess.run(
        [folder / "postgres", "--version"], capture_output=True, text=True, check=False
    ).stdout
    version = re.search(r"\d+", output)
    return Binaries(folder, int(version[0])) if version else None


def _share_folder(folder: Path) -> Path:
    pg_config = folder / "pg_config"
    if not pg_config.is_file():
        return folder.parent / "share"
    output = subprocess.run(
        [pg_config, "--sharedir"], capture_output=True, text=True, check=False
    ).stdout
    return Path(output.strip())


def _user(entry: pwd.struct_passwd) -> ServerUser:
    return ServerUser(entry.pw_name, entry.pw_uid, entry.pw_gid)


def _user_name(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)
