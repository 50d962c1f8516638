"""The files for containers say what the product has: they are read closely, not run."""

import re
import shlex
from pathlib import Path

import yaml
from typer.main import get_command

from app.cli.main import app
from app.config import Settings
from app.main import create_app
from app.web import page

ROOT = Path(__file__).parent.parent
COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text())
DOCKERFILE = (ROOT / "Dockerfile").read_text()
OWN = {name: service for name, service in COMPOSE["services"].items() if name != "db"}


def known(words: list[str]) -> bool:
    """Whether `amers` has such a command with such options."""
    command = get_command(app)
    assert words.pop(0) == "amers"
    while words and hasattr(command, "commands"):
        command = command.commands[words.pop(0)]
    options = {
        name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)
    }
    return set(words) <= options


def test_every_command_of_the_containers_is_one_of_amers():
    commands = [service["command"] for service in OWN.values()]
    (default,) = re.findall(r"^CMD (\[.*\])$", DOCKERFILE, re.MULTILINE)
    for command in [*commands, yaml.safe_load(default)]:
        assert known(list(command)), command


def test_every_variable_of_the_containers_is_a_setting():
    settings = {f"AMERS_{name.upper()}" for name in Settings.model_fields}
    given = {name for service in OWN.values() for name in service["environment"]}
    set_in_image = set(re.findall(r"\b(AMERS_\w+)=", DOCKERFILE))
    assert given | set_in_image <= settings
    assert "AMERS_DATABASE_URL" in given


def test_the_health_of_the_api_is_asked_at_a_path_it_has():
    program = COMPOSE["services"]["api"]["healthcheck"]["test"]
    assert program[:3] == ["CMD", "python", "-c"]
    compile(program[3], "healthcheck", "exec")
    (path,) = re.findall(r"http://127\.0\.0\.1:8000(/\w+)", program[3])
    assert "get" in create_app(Settings()).openapi()["paths"][path]


def test_everything_waits_for_what_it_needs():
    services = COMPOSE["services"]
    for name, service in services.items():
        for needed, how in service.get("depends_on", {}).items():
            assert needed in services, name
            if how["condition"] == "service_healthy":
                assert "healthcheck" in services[needed]
            if how["condition"] == "service_completed_successfully":
                assert services[needed]["restart"] == "no", f"{needed} never completes"
    assert services["api"]["depends_on"].keys() == services["worker"]["depends_on"].keys() == {"upgrade"}


def test_api_and_worker_share_their_files_and_write_nowhere_else():
    data = set()
    for name in ("api", "worker"):
        service = OWN[name]
        assert service["read_only"] is True
        assert service["tmpfs"] == ["/tmp"]
        assert service["cap_drop"] == ["ALL"]
        data |= {volume for volume in service["volumes"]}
    (shared,) = data
    volume, folder = shared.split(":")
    assert volume in COMPOSE["volumes"]
    assert f"AMERS_DATA_FOLDER={folder}" in DOCKERFILE
    (caches,) = re.findall(r"NUMBA_CACHE_DIR=(\S+)", DOCKERFILE)
    assert caches.startswith(folder)


def test_no_secret_stands_in_the_files_and_only_this_machine_is_listened_to():
    text = (ROOT / "docker-compose.yml").read_text()
    asked_for = "${AMERS_DB_PASSWORD:?set AMERS_DB_PASSWORD}"
    assert COMPOSE["services"]["db"]["environment"]["POSTGRES_PASSWORD"] == asked_for
    assert f"amers:{asked_for}@db" in text
    ports = [port for service in COMPOSE["services"].values() for port in service.get("ports", ())]
    assert ports
    assert all(port.startswith("127.0.0.1:") for port in ports)


def test_what_the_image_copies_is_there_and_not_kept_from_it():
    let_in = [line[1:] for line in (ROOT / ".dockerignore").read_text().split() if line.startswith("!")]
    for line in re.findall(r"^COPY (?!--from)(.*)$", DOCKERFILE, re.MULTILINE):
        *sources, _ = shlex.split(line)
        assert all((ROOT / source).exists() for source in sources), line
        assert all(Path(source).parts[0] in let_in for source in sources), line


def test_the_image_has_the_page_built_where_the_service_looks_for_it():
    (source, target) = re.findall(r"^COPY --from=page (\S+) (\S+)$", DOCKERFILE, re.MULTILINE)[0]
    assert source == f"/build/{target}"
    assert ROOT / target == page.BUILT
