"""Try the files of a release as their users install them: `python -m scripts.check_release dist`.

Each distribution gets an environment of its own, outside the checkout. Everything runs in a folder with
modules of others, such as `app`, `services` and `numpy.py`. `--quick` leaves out the sources, which
build the same wheel, and what computes: the demonstration, the service, the client on it, the recipes.
"""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.error import URLError
from urllib.request import urlopen

from scripts.make_release import ROOT, contents, distributions, version
from scripts.recipes import OF_OTHERS, recipes, write_files, write_modules_of_others

PORT = 28_571
PATIENCE_S = 600.0
CLIENT = """
from amers_client import Client

with Client("http://127.0.0.1:{port}") as client:
    print(client.count("points")[0], len(list(client.points())), len(client.blocks()))
"""
NAMES = """
import amers

print(amers.__version__, *(getattr(amers, name).__name__ for name in amers.__all__))
"""


class Installation:
    """An environment with one distribution, and a working folder with modules of others."""

    def __init__(self, folder: Path, distribution: Path) -> None:
        """Install the distribution with the exact versions of the checkout."""
        self.bin, self.work, self.distribution = folder / "venv" / "bin", folder / "work", distribution
        write_modules_of_others(self.work)
        names = {name for name in os.environ if name.startswith(("AMERS_", "PYTHON"))}
        self.environment = {name: os.environ[name] for name in os.environ.keys() - names}
        self.environment["AMERS_DATA_FOLDER"] = str(folder / "data")
        self.environment["AMERS_PUBLIC_POINTS"] = "true"
        self.run(sys.executable, "-m", "venv", folder / "venv")
        pip = ("-m", "pip", "install", "--quiet", "--no-compile", "--disable-pip-version-check")
        self.run(self.bin / "python", *pip, "-c", ROOT / "constraints.txt", distribution)

    def run(self, *words: str | Path) -> str:
        """What a command prints in the working folder.

        Raises:
            SystemExit: it fails.
        """
        done = subprocess.run(
            list(map(str, words)),
            cwd=self.work,
            env=self.environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            sys.exit(
                f"{self.distribution.name}: {' '.join(map(str, words))}: {done.stdout}{done.stderr}"
            )
        return done.stdout

    def program(self, text: str) -> str:
        """What a program prints that lies in the working folder."""
        (self.work / "program.py").write_text(text)
        return self.run(self.bin / "python", "program.py")

    def packages(self) -> set[str]:
        """The distributions of the environment, but for those that every environment has."""
        listed = self.run(self.bin / "python", "-m", "pip", "list", "--format=freeze")
        return {line.partition("==")[0].lower() for line in listed.split()} - {"pip", "setuptools"}


def check_release(folder: Path, *, quick: bool) -> None:
    """Try all files of a release.

    Raises:
        SystemExit: one does not do what it should.
    """
    wheel, client_wheel = distributions(folder)
    sources = next(folder.glob("amers-*.tar.gz"))
    plugin = contents(next(folder.glob("amers-qgis-*.zip")))
    require("qgisMinimumVersion" in plugin["amers/metadata.txt"].decode(), "the plugin has no metadata")
    with TemporaryDirectory() as temporary:
        # The server of the database runs as another user where the check runs as root.
        Path(temporary).chmod(0o711)
        client = Installation(Path(temporary) / "client", client_wheel)
        require("numpy" not in client.packages(), "the client installs NumPy")
        client.program("from amers_client import Client, JobFailed")
        say(f"{client_wheel.name}: {', '.join(sorted(client.packages()))}")
        for distribution in (wheel,) if quick else (sources, wheel):
            installation = Installation(Path(temporary) / distribution.name, distribution)
            check_installed(installation)
        if not quick:
            check_demo(installation)
            check_service(installation, client)
            check_recipes(installation)


def check_installed(installation: Installation) -> None:
    """The command and the library of an installation load, and it is one package."""
    python = installation.bin / "python"
    told = installation.run(installation.bin / "amers", "--version").strip()
    require(told == version(), f"version {told}, {version()} expected")
    require(installation.run(python, "-m", "amers", "--version").strip() == version(), "-m amers")
    printed = installation.program(NAMES)
    require(printed.startswith(f"{version()} AmersError Block Client "), printed)
    packages = Path(installation.run(python, "-P", "-c", "import amers; print(amers.__file__)")).parents[
        1
    ]
    others = [name for name in ("app", "services", "migrations", "tests") if (packages / name).exists()]
    require(not others, f"also installs {others}")
    say(f"{installation.distribution.name}: {printed.strip()}")


def check_demo(installation: Installation) -> None:
    """The demonstration runs, and the program of the README on what it leaves."""
    started = time.monotonic()
    printed = installation.run(installation.bin / "amers", "demo", "-o", "demo-output", "--json")
    require(json.loads(printed)["verdict"] == "good", printed)
    program = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    require(program is not None and installation.program(program[1]).strip() == "good", "README")
    say(f"amers demo and the program of the README: {time.monotonic() - started:.0f} s")


def check_service(installation: Installation, client: Installation) -> None:
    """The service shows its map, and the client alone reads the points of the demonstration."""
    amers = installation.bin / "amers"
    installation.run(amers, "block", "ingest", "demo-output/block", "--publish")
    words = [str(amers), "serve", "--port", str(PORT)]
    process = subprocess.Popen(words, cwd=installation.work, env=installation.environment)
    try:
        page = wait_for(f"http://127.0.0.1:{PORT}/map")
        require("<script" in page, "the page at /map has no script")
        count, read, blocks = map(int, client.program(CLIENT.format(port=PORT)).split())
        require(count == read > 0 and blocks == 1, f"{count} points, {read} read, {blocks} blocks")
        say(f"amers serve: /map, and {read} points by amers_client")
    finally:
        process.terminate()
        process.wait()


def check_recipes(installation: Installation) -> None:
    """Every program of docs/library.md runs."""
    write_files(installation.work)
    for name, program in recipes().items():
        started = time.monotonic()
        installation.program(program)
        say(f"recipe: {name} ({time.monotonic() - started:.0f} s)")


def wait_for(address: str) -> str:
    """The page at an address, once it answers."""
    end = time.monotonic() + PATIENCE_S
    while True:
        try:
            with urlopen(address) as reply:
                return str(reply.read().decode())
        except (URLError, ConnectionError):
            require(time.monotonic() < end, f"{address} does not answer")
            time.sleep(1.0)


def require(holds: bool, otherwise: str) -> None:
    """End the check where something does not hold."""
    if not holds:
        sys.exit(otherwise)


def say(line: str) -> None:
    """Print a line at once: the next step takes its time."""
    print(line, flush=True)


if __name__ == "__main__":
    check_release(Path(sys.argv[1]).resolve(), quick="--quick" in sys.argv[2:])
    print(f"beside {', '.join(OF_OTHERS)} in the working folder")
