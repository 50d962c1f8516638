"""Files that a setting makes available: those below its folder, wherever a link or a name leads."""

from pathlib import Path

import pytest

from amers.app.errors import InputError
from amers.app.usecases.server_files import file_below


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with files and links, beside others whose names begin alike."""
    folder = tmp_path / "scenes"
    for name in ("scenes/a/b.tif", "scenes-private/c.tif", "secret.tif"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    (folder / "inside").symlink_to(folder / "a")
    (folder / "outside").symlink_to(tmp_path / "scenes-private")
    (folder / "secret").symlink_to(tmp_path / "secret.tif")
    return folder


@pytest.mark.parametrize(
    "path", ["a/b.tif", "./a/../a/b.tif", "inside/b.tif", "outside/../scenes/a/b.tif"]
)
def test_a_file_below_the_folder_is_found_with_its_links_resolved(folder: Path, path: str):
    assert file_below(folder, path, "path", "AMERS_SCENE_FOLDER") == folder.resolve() / "a/b.tif"


@pytest.mark.parametrize(
    "path",
    [
        "",
        ".",
        "a",
        "a/none.tif",
        "../secret.tif",
        "../scenes-private/c.tif",
        "/etc/passwd",
        "outside/c.tif",
        "secret",
        "a\0b",
        "x" * 5000,
    ],
)
def test_whatever_lies_elsewhere_is_refused_like_what_is_not_there(folder: Path, path: str):
    with pytest.raises(InputError, match="is not a file below the folder of AMERS_SCENE_FOLDER"):
        file_below(folder, path, "path", "AMERS_SCENE_FOLDER")
