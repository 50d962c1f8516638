"""The distributions: what they hold, that both builds are equal, and that they install by themselves.

`make release` also runs the demonstration, the service and the recipes from them.
"""

from pathlib import Path

import pytest

from scripts.check_release import check_release
from scripts.make_release import PAGE, ROOT, contents, distributions, make_release, version

pytestmark = [
    pytest.mark.long,
    pytest.mark.thorough,
    pytest.mark.skipif(not (ROOT / PAGE / "index.html").is_file(), reason="`make page` has not run"),
]


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files of a release, of which the sources and the checkout build equal wheels."""
    folder = tmp_path_factory.mktemp("dist")
    make_release(folder)
    return folder


def test_sources_wheel_client_and_plugin_are_written(release: Path):
    assert sorted(path.name for path in release.iterdir()) == [
        f"amers-{version()}-py3-none-any.whl",
        f"amers-{version()}.tar.gz",
        f"amers-qgis-{version()}.zip",
        f"amers_client-{version()}-py3-none-any.whl",
    ]


def test_a_wheel_is_one_package_with_real_files_and_the_page(release: Path):
    wheel, client = distributions(release)
    files = contents(wheel)
    assert {name.partition("/")[0] for name in files} == {"amers", f"amers-{version()}.dist-info"}
    assert files["amers/app/main.py"] == (ROOT / "app/main.py").read_bytes()
    assert "amers/py.typed" in files
    assert "amers/app/web/built/index.html" in files
    assert contents(client)["amers_client/client.py"] == (ROOT / "app/client/client.py").read_bytes()


def test_the_sources_have_no_tests_and_no_tools(release: Path):
    (sources,) = release.glob("*.tar.gz")
    names = [Path(*Path(name).parts[1:]) for name in contents(sources)]
    assert {path.parts[0] for path in names} == {
        "LICENSE",
        "MANIFEST.in",
        "PKG-INFO",
        "README.md",
        "amers",
        "amers.egg-info",
        "pyproject.toml",
        "setup.cfg",
    }


def test_a_folder_that_holds_files_is_left_alone(tmp_path: Path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(SystemExit, match="an empty folder expected"):
        make_release(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_each_installs_and_loads_beside_modules_of_others(release: Path):
    check_release(release, quick=True)
