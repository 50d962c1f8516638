"""A private PostgreSQL cluster in the data folder, shared by the commands that need it.

Every command that uses the cluster holds a shared lock on the file `lease`; the kernel lets go of it
when the command ends, however it ends. The server is started by whoever finds none, under the exclusive
lock `turn`, and stopped by the last to leave: the one whose lease can be made exclusive. After a kill of
all commands the server stays, and the next command uses it and stops it. After a kill of the server the
next command starts it, and PostgreSQL recovers by itself.

Commands connect as the role `amers_app`, which owns the database and is not a superuser. Only this
module connects as the superuser, to create the database and hand it over.
"""

import fcntl
import hashlib
import os
import shutil
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import psycopg
from psycopg.conninfo import make_conninfo
from psycopg.pq import PGconn, Ping

from amers.app import reserve
from amers.app.config import Settings
from amers.app.db import session
from amers.app.db.address import check_address, with_password
from amers.app.db.cluster.binaries import ServerUser, find_binaries, run_as, server_user
from amers.app.db.sql_files import sql_file
from amers.app.errors import InputError

ROLE = "amers_app"
SUPERUSER = "amers"
DATABASE = "amers"
CREATE_DATABASE = "create database amers"
SOCKET_NAME = ".s.PGSQL.5432"
LONGEST_SOCKET_PATH = 107
START_SECONDS, STOP_SECONDS = 120.0, 60.0
LEAVING_SECONDS = 10.0
TURN_SECONDS = 2 * START_SECONDS + 2 * STOP_SECONDS
"""Longest wait for another command that starts or stops the server, which has limits of its own."""
LOCK_SECONDS = 20.0

CONFIGURATION = """\
listen_addresses = ''
unix_socket_directories = '{sockets}'
unix_socket_permissions = 0700
max_connections = 100
shared_buffers = 256MB
work_mem = 32MB
maintenance_work_mem = 256MB
max_wal_size = 4GB
random_page_cost = 1.1
jit = off
timezone = 'UTC'
log_timezone = 'UTC'
log_min_messages = warning
log_checkpoints = off
"""
FORGETFUL = "fsync = off\nfull_page_writes = off\nshared_preload_libraries = 'postgis-3'\n"
"""Of clusters of tests: nothing outlasts a power cut, and connections find PostGIS loaded."""


@contextmanager
def database(settings: Settings) -> Iterator[str]:
    """The connection string of the installation's database, which runs as long as the context lasts.

    Raises:
        InputError: the private cluster cannot be run, or the address of a database of your own cannot be
            read; the message says why and what to do.
    """
    if settings.database_url is not None:
        url = settings.database_url.get_secret_value()
        check_address(url)
        yield with_password(url, settings.database_password_file)
        return
    with _cluster(settings).lease() as dsn:
        yield dsn


def revive(settings: Settings) -> None:
    """Start the private cluster again if it was killed; nothing for a database of your own.

    To be called by a process that holds a lease and lives long.
    """
    if settings.database_url is None:
        _cluster(settings).revive()


class ServerFailure(RuntimeError):
    """PostgreSQL did not start or stop."""


@dataclass(frozen=True)
class Cluster:
    """A private cluster.

    Attributes:
        folder: everything of it: `data`, `server.log`, the locks and, if its path is short, the socket.
        durable: whether a commit survives a power cut, not only a kill; only tests do without.
    """

    folder: Path
    durable: bool = True

    @contextmanager
    def lease(self) -> Iterator[str]:
        """Use the cluster: yields a connection string; the server runs until the last lease ends.

        Raises:
            InputError: the cluster cannot be run; the message says why and what to do.
        """
        user = server_user(self.folder)
        self._make_folder(user)
        lease = os.open(self.folder / "lease", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            with self._turn():
                fcntl.flock(lease, fcntl.LOCK_SH)
                self._make_running(user)
                self._make_database(user)
            yield self.dsn(DATABASE)
        finally:
            with self._turn():
                try:
                    fcntl.flock(lease, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    pass  # somebody else still uses the server
                else:
                    self._stop(user)
                finally:
                    os.close(lease)

    def revive(self) -> None:
        """Start the server again if it was killed, for those who hold a lease and go on."""
        with self._turn():
            self._make_running(server_user(self.folder))

    @property
    def data(self) -> Path:
        """The folder PostgreSQL calls its data directory."""
        return self.folder / "data"

    @property
    def sockets(self) -> Path:
        """The folder of the server's socket: a private one under /tmp if the path would be too long."""
        own = self.folder / "socket"
        if len(os.fsencode(own / SOCKET_NAME)) <= LONGEST_SOCKET_PATH and not set(str(own)) & set(
            ",'\"\\\n"
        ):
            return own
        return (
            Path("/tmp") / f"amers-{hashlib.sha256(os.fsencode(self.folder.resolve())).hexdigest()[:16]}"
        )

    def dsn(self, name: str, role: str = ROLE) -> str:
        """The connection string of one database of the cluster."""
        return make_conninfo(host=str(self.sockets), port=5432, user=role, dbname=name)

    def hand_over(self, name: str) -> None:
        """Make the application's role the owner of a database, with PostGIS, and of all it contains.

        Raises:
            InputError: somebody else uses tables whose owner changes.
        """
        patience = {"lock_timeout": f"{LOCK_SECONDS:g}s"}
        try:
            with session.connect(self.dsn(name, SUPERUSER), patience) as connection:
                connection.execute(sql_file("ownership.sql").encode())
        except psycopg.errors.LockNotAvailable as error:
            raise InputError(
                f"the tables in {self.folder} need another owner, {ROLE}, and a command of a former "
                "Amers uses them: end it, then start this command again"
            ) from error

    def is_running(self) -> bool:
        """Whether the server answers, now or as soon as it has started or recovered."""
        deadline = time.monotonic() + START_SECONDS
        while time.monotonic() < deadline:
            answer = PGconn.ping(self.dsn("postgres").encode())
            if answer == Ping.OK:
                return True
            if answer != Ping.REJECT:
                return False
            time.sleep(0.05)
        raise ServerFailure(
            f"PostgreSQL in {self.folder} neither starts nor stops: see {self.folder / 'server.log'}"
        )

    def _has_ended(self) -> bool:
        """Whether the server, which was told to stop, removes its lock file: the last thing it does.

        One that was killed leaves the file, and takes signals until somebody collects its process.
        pg_ctl would wait for the same, but looks ten times a second only.
        """
        deadline = time.monotonic() + STOP_SECONDS
        while (server := _named_in(self.data / "postmaster.pid")) and _works_in(server, self.data):
            if time.monotonic() > deadline:
                return False
            time.sleep(0.005)
        return True

    @contextmanager
    def _turn(self) -> Iterator[None]:
        turn = os.open(self.folder / "turn", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            self._wait_for_turn(turn)
            yield
        finally:
            os.close(turn)

    def _wait_for_turn(self, turn: int) -> None:
        deadline = time.monotonic() + TURN_SECONDS
        while True:
            try:
                return fcntl.flock(turn, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise InputError(
                        f"another command has been starting or stopping PostgreSQL in {self.folder} for "
                        f"{TURN_SECONDS:g} s: end that command"
                    ) from None
            time.sleep(0.01)

    def _make_folder(self, user: ServerUser) -> None:
        try:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            with suppress(FileExistsError):
                self.folder.mkdir(mode=0o700)
                os.chown(self.folder, user.uid, user.gid)
        except OSError as error:
            raise InputError(
                f"{self.folder} cannot be made ({error.strerror}): choose another AMERS_DATA_FOLDER"
            ) from error
        if run_as(user, ["test", "-x", str(self.folder)]).returncode != 0:
            raise InputError(
                f"user {user.name}, who runs PostgreSQL, cannot enter {self.folder}: "
                "give everybody the right to pass (chmod o+x) in the folders above it, "
                "or choose another AMERS_DATA_FOLDER"
            )

    def _make_running(self, user: ServerUser) -> None:
        if not self.data.exists():
            self._initialise(user)
        if self.is_running():
            return
        reserve.give_up_for_start(self.folder)
        self._make_socket_folder(user)
        self._configure(user)
        self._forget_dead_server()
        self._start(user)

    def _make_database(self, user: ServerUser) -> None:
        """Create the database, or take over that of a former Amers, which a superuser owns."""
        with session.connect(self.dsn("postgres", SUPERUSER)) as connection:
            connection.autocommit = True
            owner = connection.execute(
                "select pg_get_userbyid(datdba) from pg_database where datname = %s", [DATABASE]
            ).fetchone()
            if owner is None:
                connection.execute(CREATE_DATABASE)
            if owner != (ROLE,):
                self.hand_over(DATABASE)
            try:
                session.connect(self.dsn(DATABASE)).close()
            except psycopg.OperationalError:
                # A former Amers has started the server, which admits the superuser only.
                self._configure(user)
                connection.execute("select pg_reload_conf()")

    def _initialise(self, user: ServerUser) -> None:
        unfinished = self.folder / "data.unfinished"
        shutil.rmtree(unfinished, ignore_errors=True)
        made = run_as(
            user,
            [
                str(find_binaries().folder / "initdb"),
                *(
                    "--pgdata",
                    str(unfinished),
                    "--username",
                    SUPERUSER,
                    "--encoding",
                    "UTF8",
                    "--locale",
                    "C",
                ),
                *("--auth", "peer", "--data-checksums", "--no-instructions"),
                *([] if self.durable else ["--no-sync"]),
            ],
        )
        if made.returncode != 0:
            raise ServerFailure(f"initdb failed: {made.stderr.strip()}")
        with (unfinished / "postgresql.conf").open("a") as configuration:
            configuration.write("\ninclude 'amers.conf'\n")
        unfinished.rename(self.data)

    def _configure(self, user: ServerUser) -> None:
        configuration = CONFIGURATION.format(sockets=self.sockets) + ("" if self.durable else FORGETFUL)
        people = dict.fromkeys(["root", user.name])
        for name, text in {
            "amers.conf": configuration,
            "pg_hba.conf": "local all all peer map=amers\n",
            "pg_ident.conf": "".join(
                f'amers "{person}" {role}\n' for person in people for role in (ROLE, SUPERUSER)
            ),
        }.items():
            path = self.data / name
            path.write_text(text)
            path.chmod(0o600)
            os.chown(path, user.uid, user.gid)

    def _make_socket_folder(self, user: ServerUser) -> None:
        with suppress(FileExistsError):
            self.sockets.mkdir(mode=0o700)
            os.chown(self.sockets, user.uid, user.gid)
        found = self.sockets.lstat()
        if (
            not stat.S_ISDIR(found.st_mode)
            or found.st_uid != user.uid
            or stat.S_IMODE(found.st_mode) != 0o700
        ):
            raise InputError(
                f"{self.sockets} must be a folder that only user {user.name} can enter: remove it"
            )

    def _forget_dead_server(self) -> None:
        """Remove lock files whose process is another one by now: PostgreSQL would believe in them."""
        for path in (self.data / "postmaster.pid", self.sockets / f"{SOCKET_NAME}.lock"):
            server = _named_in(path)
            if server and not _works_in(server, self.data):
                path.unlink(missing_ok=True)

    def _start(self, user: ServerUser) -> None:
        version = int((self.data / "PG_VERSION").read_text())
        log = self.folder / "server.log"
        command = [str(find_binaries(version).folder / "pg_ctl"), "start", "--wait", "--silent"]
        command += ["--pgdata", str(self.data), "--log", str(log), "--timeout", str(int(START_SECONDS))]
        deadline = time.monotonic() + LEAVING_SECONDS
        while run_as(user, command, timeout_s=2 * START_SECONDS).returncode != 0:
            last_lines = (
                " / ".join(log.read_text(errors="replace").splitlines()[-4:]) if log.exists() else ""
            )
            # Processes of a killed server need a moment to notice and leave the shared memory.
            if "shared memory" not in last_lines or time.monotonic() > deadline:
                raise ServerFailure(f"PostgreSQL did not start ({log}): {last_lines}")
            time.sleep(0.2)

    def _stop(self, user: ServerUser) -> None:
        if not (self.data / "postmaster.pid").exists():
            return
        pg_ctl = str(find_binaries(int((self.data / "PG_VERSION").read_text())).folder / "pg_ctl")
        for mode in ("fast", "immediate"):
            command = [pg_ctl, "stop", "--no-wait", "--silent", "--mode", mode]
            told = run_as(user, [*command, "--pgdata", str(self.data)]).returncode == 0
            if (told and self._has_ended()) or not self.is_running():
                break
        else:
            raise ServerFailure(f"PostgreSQL in {self.folder} does not stop")
        if self.sockets.parent != self.folder:
            with suppress(OSError):
                self.sockets.rmdir()


def _cluster(settings: Settings) -> Cluster:
    return Cluster(settings.data_folder / "postgres")


def _named_in(lock: Path) -> int | None:
    """The process that a lock file names; None where there is no file, or none that names one."""
    try:
        return int(lock.read_text().splitlines()[0])
    except (FileNotFoundError, ValueError, IndexError):
        return None


def _works_in(number: int, folder: Path) -> bool:
    """Whether a process lives and works in this folder, as a PostgreSQL server does in its data."""
    try:
        return Path(f"/proc/{number}/cwd").resolve(strict=True) == folder.resolve()
    except OSError:
        return False
