"""Every `amers` command of the guide, run as it is written on small files of the names it gives."""

import shutil
from contextlib import chdir
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect
from pyproj import datadir

from tests.command_line import Done, amers_here
from tests.documents import blocks_of, command_lines
from tests.journeys.guide_files import write_bases, write_geoids, write_guide_files
from tests.journeys.map_page import assert_readable
from tests.service_process import installed_at

pytestmark = [pytest.mark.long, pytest.mark.thorough]

NOT_RUN = {
    "base make --area region.geojson --from sentinel-2 --catalogue "
    "https://earth-search.aws.element84.com/v1 -o my-base --plan": "contacts a public server: "
    "test_base.py plans from one of its kind",
    "production run --selection my-selection --spacing-m 1400 -o my-block": "needs six images of "
    "kilometres, which takes minutes: test_image_addresses.py makes a block of a selection",
    "serve": "runs until a signal: the first run of the README does it",
}
"""Why a command is not run here."""
LINES = [" ".join(words) for block in blocks_of("docs/guide.md") for words in command_lines(block.text)]
RUN = [line for line in LINES if line not in NOT_RUN]
OUTPUTS = [line for line in RUN if " -o " in line]


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The folder in which each command is run: that of the reader, for bases of points others."""
    reader, bases = (tmp_path_factory.mktemp(name) for name in ("reader", "bases"))
    write_guide_files(reader)
    write_bases(bases)
    places = dict.fromkeys(RUN, reader)
    for number, line in enumerate(RUN):
        # Other ways to make the block of the reader, each with a folder of its own.
        if line.startswith(("production ortho", "production points")):
            files = bases if line.startswith("production points") else reader
            places[line] = tmp_path_factory.mktemp(f"other-{number}") / "files"
            shutil.copytree(files, places[line])
    return places


@pytest.fixture(scope="module")
def done(
    installation: Path, places: dict[str, Path], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Done]:
    """What each command does, in the order of the guide."""
    geoids = tmp_path_factory.mktemp("geoids")
    write_geoids(geoids)
    environment = installed_at(installation / "data")
    folders_of_proj = datadir.get_data_dir()
    datadir.append_data_dir(str(geoids))
    done = {}
    try:
        for line in RUN:
            with chdir(places[line]):
                done[line] = amers_here(line.split(), environment)
    finally:
        datadir.set_data_dir(folders_of_proj)
    return done


@pytest.mark.parametrize("line", RUN)
def test_a_command_of_the_guide_runs_as_it_is_written(done, line):
    assert done[line].returncode == 0, done[line].stdout + done[line].stderr


@pytest.mark.parametrize("line", OUTPUTS)
def test_a_command_of_the_guide_writes_what_it_names(done, places, line):
    assert (places[line] / line.partition(" -o ")[2].split()[0]).exists()


@pytest.mark.parametrize(
    "folder", ["my-base.report", "my-result", "my-block.adjustment", "my-selection", "together/block"]
)
def test_a_report_that_a_command_of_the_guide_writes_is_readable(done, places, folder, browser: Browser):
    with browser.new_context() as context:
        page = context.new_page()
        page.goto((places[RUN[0]] / folder / "report.html").as_uri())
        expect(page.get_by_role("heading", level=1)).to_be_visible()
        assert_readable(page, "report-" + folder.replace("/", "-"))


def test_a_command_that_is_not_run_stands_in_the_guide():
    assert set(NOT_RUN) < set(LINES)
