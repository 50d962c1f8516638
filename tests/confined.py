"""Commands as containers and units confine them: no rights, and nothing writable but given folders."""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest

NOBODY = 65534
STAGE = "/srv"
REPLACED = ("/var/lib", "/var/cache", "/var/backups", "/run", "/etc/amers")
"""Folders that a command sees empty but for what is given to it."""
VENV = Path(sys.prefix)


@dataclass(frozen=True)
class Confinement:
    """What a confined command may use beside the programs of the machine.

    Attributes:
        writable: places to folders of the test, which its user owns.
        readable: the same, read-only.
        tmp_size: of the memory behind `/tmp`.
    """

    writable: Mapping[str, Path]
    readable: Mapping[str, Path] = field(default_factory=dict)
    tmp_size: str = "64m"

    def command(self, words: Sequence[str], environment: Mapping[str, str]) -> list[str]:
        """The words that run a command in its own view of the file systems, without any privilege.

        The process of these words becomes that of the command: a signal reaches it.
        """
        given = {**self.writable, **self.readable}
        lines = ["set -e", f"mount -t tmpfs -o mode=755 stage {STAGE}"]
        base, closed = Path(sys.base_prefix), _closed_folder(Path(sys.base_prefix))
        sources = {"python": base} if closed else {}
        sources |= {str(number): source for number, source in enumerate(given.values())}
        for name, source in sources.items():
            lines += [f"mkdir {STAGE}/{name}", f"mount --bind {shlex.quote(str(source))} {STAGE}/{name}"]
        replaced = [folder for folder in REPLACED if Path(folder).is_dir()]
        replaced += [str(closed)] if closed else []
        lines += [f"mount -t tmpfs -o mode=755 empty {folder}" for folder in replaced]
        places = {"python": str(base)} if closed else {}
        places |= {str(number): place for number, place in enumerate(given)}
        for name, place in places.items():
            lines += [f"mkdir -p {place}", f"mount --move {STAGE}/{name} {place}"]
        lines.append(f"mount -t tmpfs -o size={self.tmp_size},mode=1777 tmp /tmp")
        kept = "|".join(["/proc*", "/sys*", "/dev*", "/tmp", *self.writable])
        lines += [
            "while read -r _ place _; do",
            f'  case "$place" in {kept}) continue ;; esac',
            '  mount -o remount,bind,ro "$place" 2>/dev/null || :',
            "done < /proc/self/mounts",
            "cd /",
            f"exec setpriv --reuid={NOBODY} --regid={NOBODY} --clear-groups --no-new-privs "
            '--bounding-set=-all --inh-caps=-all -- "$@"',
        ]
        variables = [f"{name}={value}" for name, value in environment.items()]
        script = ["sh", "-c", "\n".join(lines), "sh", "env", "-i", *variables, *words]
        return ["unshare", "--mount", "--", *script]

    def run(
        self, words: Sequence[str], environment: Mapping[str, str], timeout_s: float = 120.0
    ) -> "subprocess.CompletedProcess[str]":
        """Run a command to its end."""
        return subprocess.run(
            self.command(words, environment),
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )


def owned_folder(folder: Path) -> Path:
    """A new folder that the confined user owns."""
    folder.mkdir(parents=True)
    os.chown(folder, NOBODY, NOBODY)
    return folder


def path_of_amers() -> str:
    """The search path with the programs of this environment, as an installation has them."""
    return f"{VENV / 'bin'}:/usr/bin:/bin"


def skip_unless_possible() -> None:
    """Skip a test where this machine cannot confine a process so."""
    if os.geteuid() != 0:
        pytest.skip("only root can give a process its own view of the file systems")
    missing = [name for name in ("unshare", "setpriv", "mount") if shutil.which(name) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} of util-linux is missing: no process can be confined")
    tried = Confinement({}).run(["true"], {})
    if tried.returncode != 0:
        pytest.skip(f"no process can be confined here: {tried.stderr.strip()}")
    can_read = Confinement({}).run(
        ["python", "-c", "import amers.app.cli.main"], {"PATH": path_of_amers()}
    )
    if can_read.returncode != 0:
        pytest.skip("a user without rights cannot read this checkout or its environment")


def _closed_folder(path: Path) -> Path | None:
    """The folder above a path that others may not pass; None if they may pass all."""
    above = [path, *path.parents][::-1]
    return next((folder for folder in above if not folder.stat().st_mode & 0o001), None)
