"""Write the files of a release: `python -m scripts.make_release dist`.

| file | holds |
|---|---|
| `amers-VERSION.tar.gz` | the sources of the package, with the built page |
| `amers-VERSION-py3-none-any.whl` | the package, built from these sources |
| `amers_client-VERSION-py3-none-any.whl` | the Python client alone |
| `amers-qgis-VERSION.zip` | the QGIS plugin |

They are built from a copy of the files under version control, so that nothing else gets into them; their
members have the time of the last commit.
"""

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from zipfile import ZipFile

from scripts.make_plugin import write_plugin

ROOT = Path(__file__).parents[1]
PAGE = Path("app/web/built")
"""What `make page` writes; it is not under version control."""
PACKAGES = ("app", "migrations", "services")
SUFFIXES = {".py", ".html", ".css", ".json", ".sql", ".mako", ".typed"}
"""Of the files of a package, beside the page."""


def make_release(folder: Path) -> list[Path]:
    """Write the files of a release into an empty folder; returns them by name.

    Raises:
        SystemExit: the page is not built, the folder holds other files, or a distribution has other
            members than it should.
    """
    if not (ROOT / PAGE / "index.html").is_file():
        sys.exit(f"{PAGE} has no page: run `make page`")
    folder.mkdir(parents=True, exist_ok=True)
    if any(folder.iterdir()):
        sys.exit(f"{folder}: holds files, an empty folder expected")
    with TemporaryDirectory() as temporary:
        tree = Path(temporary) / "amers"
        copy_sources(tree)
        build(tree, folder)
        build(tree / "client", folder, "--wheel")
        again = Path(temporary) / "again"
        build(tree, again, "--wheel")
        wheel, client = distributions(folder)
        refuse_others(wheel, "amers", package_members())
        refuse_others(client, "amers_client", client_members())
        if contents(wheel) != contents(next(again.iterdir())):
            sys.exit(f"{wheel.name}: the sources and the checkout build different wheels")
    write_plugin(folder / f"amers-qgis-{version()}.zip")
    return sorted(folder.iterdir())


def version() -> str:
    """The version of `pyproject.toml`."""
    return str(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"])


def distributions(folder: Path) -> tuple[Path, Path]:
    """The wheels of Amers and of the client in the folder of a release."""
    return next(folder.glob("amers-*.whl")), next(folder.glob("amers_client-*.whl"))


def build(project: Path, folder: Path, *options: str) -> None:
    """Build a project into a folder: its sources and the wheel of them, or the wheel alone."""
    seconds = git("log", "-1", "--format=%ct").strip()
    command = [sys.executable, "-m", "build", *options, "--outdir", str(folder), str(project)]
    done = subprocess.run(
        command,
        env={**os.environ, "SOURCE_DATE_EPOCH": seconds},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(done.stdout + done.stderr)


def git(*words: str) -> str:
    """What a command of git prints."""
    return subprocess.check_output(["git", *words], cwd=ROOT, text=True)


def tracked(*places: str) -> list[Path]:
    """Files under version control, links included, relative to the root."""
    return [Path(name) for name in git("ls-files", "-z", *places).split("\0") if name]


def copy_sources(tree: Path) -> None:
    """Copy the files under version control, as they are now, and the built page."""
    for path in tracked():
        if (ROOT / path).exists():
            (tree / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / path, tree / path, follow_symlinks=False)
    shutil.copytree(ROOT / PAGE, tree / PAGE)


def package_members() -> set[str]:
    """The files that the wheel of Amers has, beside what describes it."""
    own = [path for path in tracked("amers") if not (ROOT / path).is_symlink()]
    folders = [Path("amers") / path for path in tracked(*PACKAGES)]
    page = [Path("amers") / PAGE / path.name for path in (ROOT / PAGE).iterdir()]
    there = [path for path in (*own, *folders) if path.suffix in SUFFIXES]
    return {path.as_posix() for path in (*there, *page)}


def client_members() -> set[str]:
    """The files that the wheel of the client has, beside what describes it."""
    return {f"amers_client/{path.name}" for path in tracked("app/client")}


def refuse_others(wheel: Path, package: str, expected: set[str]) -> None:
    """Refuse a wheel with other members than those of its package and its description.

    Raises:
        SystemExit: it has some, or lacks some.
    """
    described = f"{package}-{version()}.dist-info"
    found = {name for name in contents(wheel) if PurePosixPath(name).parts[0] != described}
    if found != expected:
        wrong = sorted(found ^ expected)
        sys.exit(f"{wheel.name}: {len(wrong)} files too many or missing: {', '.join(wrong[:10])}")


def contents(path: Path) -> dict[str, bytes]:
    """The files of a wheel, a zip or a tar, by name."""
    if path.suffix == ".gz":
        with tarfile.open(path) as archive:
            files = [member for member in archive.getmembers() if member.isfile()]
            streams = {member.name: archive.extractfile(member) for member in files}
            return {name: stream.read() for name, stream in streams.items() if stream is not None}
    with ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist() if not name.endswith("/")}


if __name__ == "__main__":
    for file in make_release(Path(sys.argv[1])):
        print(f"{file.stat().st_size / 1e6:8.2f} MB  {file}")
