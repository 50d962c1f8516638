"""`amers points query --server`: the points of a service are those of its store."""

import csv
import io
import json
from collections.abc import Callable, Iterator

import pytest
from typer.testing import CliRunner

from amers.app.cli.exit_status import FAILURE
from amers.app.cli.failures import failure
from amers.app.cli.main import app as commands
from amers.app.client import RequestRefused, ServiceFailure
from amers.app.client import client as client_module
from amers.app.errors import InputError
from tests.app.running_service import Served, service_with_a_block
from tests.service_process import free_port

EVERYTHING = ("--bbox", "5,43,6,44")
SOME = ("--bbox", "5,43,5.25,44")
NOTHING = ("--bbox", "0,0,1,1")
points_of_the_block = 60


@pytest.fixture(scope="module")
def served(cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with service_with_a_block(cluster, tmp_path_factory.mktemp("served"), "read") as served:
        yield served


@pytest.fixture
def run(served: Served, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Runs `amers points query` beside the store of the service; returns its output."""
    monkeypatch.setenv("AMERS_DATABASE_URL", served.dsn)
    monkeypatch.setenv("AMERS_DATA_FOLDER", str(served.folder / "data"))
    monkeypatch.setenv("AMERS_TOKEN", served.authorization["Authorization"].split()[1])
    # Seven points on a page: the rows have nine pages.
    monkeypatch.setattr(client_module, "PAGE", 7)

    def run(*words: str) -> str:
        result = CliRunner().invoke(commands, ["points", "query", *words], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.stdout

    return run


def test_the_service_gives_the_points_that_its_store_gives(run, served):
    of_store, of_service = (
        json.loads(run(*EVERYTHING, *more)) for more in ((), ("--server", served.url))
    )
    assert len(of_service["features"]) == points_of_the_block
    for stored, sent in zip(of_store["features"], of_service["features"], strict=True):
        assert sent == stored


@pytest.mark.parametrize("box", [EVERYTHING, SOME, NOTHING], ids=["60 points", "some", "none"])
def test_the_rows_of_the_service_are_those_of_its_store_and_as_many_as_it_counts(run, served, box):
    found = []
    for more in ((), ("--server", served.url)):
        found.append(list(csv.DictReader(io.StringIO(run(*box, "--format", "csv", *more)))))
        assert json.loads(run(*box, "--json", *more))["points"] == len(found[-1])
    assert found[0] == found[1]
    assert (0 < len(found[0]) < points_of_the_block) == (box == SOME)


def test_a_box_without_points_is_an_empty_collection(run, served):
    assert json.loads(run(*NOTHING, "--server", served.url))["features"] == []


def test_the_number_of_points_of_a_service_and_a_file_of_them(run, served, tmp_path):
    service = ("--server", served.url, "--json")
    number = json.loads(run(*EVERYTHING, *service))
    assert number == {"points": points_of_the_block, "exact": True, "file": None}
    file = tmp_path / "points.geojson"
    written = json.loads(run(*EVERYTHING, *service, "-o", str(file)))
    assert written == {"file": str(file), "size_bytes": file.stat().st_size}
    assert len(json.loads(file.read_text())["features"]) == points_of_the_block


def test_a_refusal_names_the_service_and_leaves_no_file(run, served, tmp_path, monkeypatch):
    monkeypatch.setenv("AMERS_TOKEN", "wrong")
    file = tmp_path / "points.geojson"
    with pytest.raises(RequestRefused, match="unknown, expired or revoked"):
        run(*EVERYTHING, "--server", served.url, "-o", str(file))
    assert list(tmp_path.iterdir()) == []


def test_a_service_that_does_not_answer_is_named_with_what_to_do(run):
    address = f"http://127.0.0.1:{free_port()}"
    with pytest.raises(ServiceFailure) as raised:
        run(*EVERYTHING, "--server", address)
    sentence, status = failure(raised.value)
    assert sentence.startswith(address)
    assert sentence.endswith("see that the service answers at this address, then run the command again")
    assert status == FAILURE


def test_heights_are_refused_where_a_service_is_asked(run, served):
    with pytest.raises(InputError, match="give four: W,S,E,N"):
        run("--bbox", "5,43,0,6,44,100", "--server", served.url)
