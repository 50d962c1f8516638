"""The private cluster: shared, started and stopped on demand, and robust against killed processes."""

import fcntl
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from uuid import uuid4

import psycopg
import pytest

from amers.app.db.cluster import binaries, embedded
from amers.app.db.cluster.binaries import find_binaries, server_user
from amers.app.db.cluster.embedded import LONGEST_SOCKET_PATH, SOCKET_NAME, Cluster
from amers.app.errors import InputError

pytestmark = pytest.mark.long

USER = """
import itertools, sys
from pathlib import Path
import psycopg
from amers.app.db.cluster.embedded import Cluster
with Cluster(Path(sys.argv[1]), durable=False).lease() as dsn:
    for line in itertools.chain([""], sys.stdin):
        with psycopg.connect(dsn) as connection:
            print(connection.execute("select 41 + 1").fetchone()[0], flush=True)
"""
LISTENING = "0A"


class User:
    """Another process that uses the cluster until it is stopped or killed."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-c", USER, str(folder)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.answer = self.process.stdout.readline().strip()

    def ask(self) -> str:
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return self.process.stdout.readline().strip()

    def leave(self) -> int:
        self.process.communicate(timeout=60)
        return self.process.returncode

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.communicate(timeout=60)


@pytest.fixture(scope="module")
def pattern(open_folder):
    """A stopped cluster to copy, which is quicker than creating one."""
    cluster = Cluster(open_folder / "pattern", durable=False)
    with cluster.lease():
        pass
    return cluster


@pytest.fixture
def own(bare, pattern):
    """A created and stopped cluster of this test alone."""
    subprocess.run(["cp", "--archive", pattern.folder, bare.folder], check=True)
    return bare


@pytest.fixture
def bare(open_folder):
    """A cluster of this test alone, not created yet."""
    cluster = Cluster(open_folder / uuid4().hex[:8], durable=False)
    yield cluster
    if (cluster.data / "postmaster.pid").exists():
        with cluster.lease():
            pass
    shutil.rmtree(cluster.folder, ignore_errors=True)


def postmaster(cluster: Cluster) -> int:
    return int((cluster.data / "postmaster.pid").read_text().splitlines()[0])


def kill_server(cluster: Cluster) -> None:
    process = postmaster(cluster)
    os.kill(process, signal.SIGKILL)
    while Path(f"/proc/{process}/cwd").exists():
        time.sleep(0.01)


def has_stopped(cluster: Cluster) -> bool:
    return not (cluster.data / "postmaster.pid").exists() and not cluster.is_running()


def test_the_first_user_makes_and_starts_it_and_the_last_one_stops_it(bare):
    with bare.lease() as first:
        with bare.lease() as second:
            assert first == second
        with psycopg.connect(first) as connection:
            assert connection.execute("show server_encoding").fetchone() == ("UTF8",)
            assert connection.execute("show data_checksums").fetchone() == ("on",)
    assert has_stopped(bare)


def test_a_commit_is_durable_unless_a_test_says_otherwise(own):
    with Cluster(own.folder).lease() as dsn, psycopg.connect(dsn) as connection:
        for setting in ("fsync", "synchronous_commit", "full_page_writes"):
            assert connection.execute(f"show {setting}").fetchone() == ("on",), setting


def test_it_listens_on_no_tcp_port(own):
    with own.lease():
        process = Path("/proc") / str(postmaster(own))
        sockets = {os.readlink(link) for link in (process / "fd").iterdir()}
        for table in ("tcp", "tcp6"):
            rows = [line.split() for line in (process / "net" / table).read_text().splitlines()[1:]]
            listening = {f"socket:[{row[9]}]" for row in rows if row[3] == LISTENING}
            assert not listening & sockets


def test_only_its_user_can_reach_the_socket(own):
    with own.lease():
        socket_status = own.sockets.stat()
        assert socket_status.st_mode & 0o077 == 0
        assert socket_status.st_uid == server_user(own.folder).uid != 0


def test_a_server_that_was_killed_is_not_waited_for(own, monkeypatch):
    """Where nobody collects dead processes, they take signals still."""
    waited = []

    def sleep(seconds: float) -> None:
        waited.append(seconds)
        time.sleep(seconds)

    monkeypatch.setattr(embedded, "STOP_SECONDS", 5.0)
    lock = own.data / "postmaster.pid"
    with own.lease():
        kill_server(own)
        dead = subprocess.Popen(["true"], user=server_user(own.folder).uid)
        os.waitid(os.P_PID, dead.pid, os.WEXITED | os.WNOWAIT)
        _, *others = lock.read_text().splitlines()
        lock.write_text("\n".join([str(dead.pid), *others, ""]))
        monkeypatch.setattr(embedded, "time", SimpleNamespace(monotonic=time.monotonic, sleep=sleep))
    assert sum(waited) < 1.0
    dead.wait()


def test_the_kill_of_one_user_leaves_the_other_undisturbed(own):
    one, other = User(own.folder), User(own.folder)
    one.kill()
    assert other.ask() == "42"
    with own.lease():
        pass
    assert other.ask() == "42"
    assert other.leave() == 0
    assert has_stopped(own)


def test_after_the_kill_of_all_users_the_next_one_takes_over_and_stops_it(own):
    one, other = User(own.folder), User(own.folder)
    one.kill()
    other.kill()
    assert own.is_running()
    assert User(own.folder).leave() == 0
    assert has_stopped(own)


def test_after_a_kill_of_the_server_the_next_user_finds_what_was_committed(own):
    with own.lease() as dsn:
        with psycopg.connect(dsn) as connection:
            connection.execute("create table kept as select 1")
        kill_server(own)
        with own.lease() as again, psycopg.connect(again) as connection:
            assert connection.execute("select count(*) from kept").fetchone() == (1,)
    assert has_stopped(own)


def test_a_kill_while_the_cluster_is_made_leaves_nothing_that_hinders_the_next_user(own):
    with own.lease():
        pass
    own.data.rename(own.folder / "data.unfinished")
    (own.folder / "data.unfinished" / "PG_VERSION").unlink()
    with own.lease() as dsn, psycopg.connect(dsn) as connection:
        assert connection.execute("select 1").fetchone() == (1,)


def test_a_lock_file_whose_process_is_another_one_by_now_does_not_stop_it(own):
    with own.lease():
        lines = (own.data / "postmaster.pid").read_text().splitlines()
    with subprocess.Popen(["sleep", "60"]) as stranger:
        (own.data / "postmaster.pid").write_text("\n".join([str(stranger.pid), *lines[1:]]) + "\n")
        try:
            with own.lease() as dsn, psycopg.connect(dsn) as connection:
                assert connection.execute("select 1").fetchone() == (1,)
        finally:
            stranger.terminate()


@pytest.mark.thorough
def test_users_that_come_at_once_share_one_server(bare):
    with ThreadPoolExecutor(3) as pool:
        users = list(pool.map(User, [bare.folder] * 3))
    assert [user.answer for user in users] == ["42"] * 3
    assert [user.leave() for user in users] == [0] * 3
    assert has_stopped(bare)


def test_ctrl_c_in_the_terminal_does_not_reach_the_server(own):
    with own.lease():
        assert os.getsid(postmaster(own)) != os.getsid(0)
        assert os.getpgid(postmaster(own)) != os.getpgid(0)


def test_a_path_too_long_for_a_socket_gets_a_private_folder_elsewhere(bare):
    deep = Cluster(bare.folder / ("d" * LONGEST_SOCKET_PATH), durable=False)
    bare.folder.mkdir(mode=0o755)
    with deep.lease() as dsn, psycopg.connect(dsn) as connection:
        assert connection.execute("select 1").fetchone() == (1,)
        assert deep.sockets.parent == Path("/tmp")
    assert not deep.sockets.exists()


@pytest.mark.parametrize("letter", ["d", "ü"])
def test_the_path_of_a_socket_is_never_too_long_and_in_the_folder_wherever_it_fits(letter):
    """Bytes count, of which a letter can have two."""
    for length in range(130):
        cluster = Cluster(Path("/x" + letter * length))
        own = cluster.folder / "socket"
        path = len(os.fsencode(cluster.sockets / SOCKET_NAME))
        assert path <= 107
        assert (cluster.sockets == own) == (len(os.fsencode(own / SOCKET_NAME)) <= 107)
    for wrong in ",'\"\\\n":
        assert Cluster(Path(f"/x{wrong}y")).sockets.parent == Path("/tmp")


def test_a_socket_folder_that_others_could_have_made_is_refused(bare):
    deep = Cluster(bare.folder / ("d" * LONGEST_SOCKET_PATH), durable=False)
    bare.folder.mkdir(mode=0o755)
    deep.sockets.mkdir()
    deep.sockets.chmod(0o777)
    try:
        with pytest.raises(InputError, match="remove it"), deep.lease():
            pass
    finally:
        deep.sockets.rmdir()


def test_a_folder_that_the_server_cannot_use_is_refused_with_what_to_do(bare):
    bare.folder.mkdir()
    bare.folder.chmod(0o700 if os.geteuid() == 0 else 0o500)
    inner = Cluster(bare.folder / "inner", durable=False)
    with pytest.raises(InputError, match="choose another AMERS_DATA_FOLDER"), inner.lease():
        pass


def test_without_postgresql_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr(binaries, "USUAL_FOLDERS", ())
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(InputError, match="apt-get install postgresql") as refused:
        find_binaries()
    assert "\n" not in str(refused.value)


def test_a_cluster_of_a_version_that_is_not_installed_is_refused():
    with pytest.raises(InputError, match="made by PostgreSQL 9"):
        find_binaries(9)


def test_a_server_that_does_not_start_says_why(own):
    with own.lease():
        pass
    with (own.data / "postgresql.conf").open("a") as configuration:
        configuration.write("no_such_setting = 1\n")
    with pytest.raises(RuntimeError, match="no_such_setting"), own.lease():
        pass


def test_a_server_that_was_killed_is_revived_for_those_who_still_hold_a_lease(own):
    with own.lease() as dsn:
        kill_server(own)
        own.revive()
        with psycopg.connect(dsn) as connection:
            assert connection.execute("select 1").fetchone() == (1,)
    assert has_stopped(own)


def test_a_command_that_holds_the_turn_for_ever_is_not_waited_for(
    open_folder: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(embedded, "TURN_SECONDS", 0.1)
    folder = open_folder / uuid4().hex
    folder.mkdir(mode=0o700)
    user = server_user(folder)
    os.chown(folder, user.uid, user.gid)
    with (folder / "turn").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="another command"):
            Cluster(folder).revive()
