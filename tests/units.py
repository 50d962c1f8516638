"""The units of `examples/systemd`, read as systemd reads them and run without it."""

import os
import shlex
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.confined import NOBODY, Confinement, path_of_amers

FOLDER = Path(__file__).parent.parent / "examples" / "systemd"
NAMES = sorted(path.name for path in FOLDER.iterdir() if path.suffix in (".service", ".timer"))
INSTALLED = "/opt/amers/bin"
STATE, CACHE = "/var/lib/amers", "/var/cache/amers"
SETTINGS = "/etc/amers"


def directives(name: str) -> dict[str, list[str]]:
    """The values of each directive of a unit, in their order."""
    found = defaultdict(list)
    for line in (FOLDER / name).read_text().splitlines():
        if line and not line.startswith(("#", "[")):
            key, _, value = line.partition("=")
            found[key].append(value)
    return found


def text_on_this_machine(name: str) -> str:
    """A unit whose programs are where this machine has them."""
    text = (FOLDER / name).read_text()
    text = text.replace(f"{INSTALLED}/amers-backup", str(FOLDER / "amers-backup"))
    return text.replace(f"{INSTALLED}/", f"{path_of_amers().split(':')[0]}/")


@dataclass(frozen=True)
class Machine:
    """What units see of a machine.

    Attributes:
        folders: places to folders of the test that the user of the units owns.
        settings: the folder `/etc/amers`.
        variables: what the test sets besides, such as free ports.
    """

    folders: Mapping[str, Path]
    settings: Path
    variables: Mapping[str, str]

    def command(self, name: str) -> list[str]:
        """The words that run the command of a unit, confined as the unit says."""
        (line,) = directives(name)["ExecStart"]
        words = shlex.split(line)
        program = Path(words[0]).name
        words[0] = str(FOLDER / program) if program == "amers-backup" else program
        return self.confinement(name).command(words, self.environment(name))

    def environment(self, name: str) -> dict[str, str]:
        """The variables of a unit."""
        unit = directives(name)
        own = dict(word.split("=", 1) for line in unit["Environment"] for word in shlex.split(line))
        (file,) = unit["EnvironmentFile"]
        lines = (self.settings / Path(file).name).read_text().splitlines()
        given = dict(line.split("=", 1) for line in lines if line and not line.startswith("#"))
        return {**own, **given, **self.variables, "PATH": path_of_amers()}

    def confinement(self, name: str) -> Confinement:
        """The file systems of a unit."""
        unit = directives(name)
        assert unit["ProtectSystem"] == ["strict"]
        assert unit["PrivateTmp"] == ["yes"]
        places = [f"/var/lib/{one}" for one in unit["StateDirectory"]]
        places += [f"/var/cache/{one}" for one in unit["CacheDirectory"]] + unit["ReadWritePaths"]
        writable = {place: self.folders[place] for place in places}
        return Confinement(writable, {SETTINGS: self.settings})


def settings_folder(folder: Path, password: str) -> Path:
    """A folder `/etc/amers` as the document installs it."""
    folder.mkdir()
    (folder / "amers.env").write_text((FOLDER / "amers.env").read_text())
    (folder / "database_password").write_text(password)
    for path in (folder, *folder.iterdir()):
        os.chown(path, 0, NOBODY)
        path.chmod(0o750 if path.is_dir() else 0o640)
    return folder
