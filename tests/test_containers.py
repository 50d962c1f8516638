"""The files for containers say what the product has: they are read closely, not run."""

import os
import re
import shlex
import subprocess
from importlib.metadata import distribution
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from typer.main import get_command

from amers.app.cli.main import app
from amers.app.config import Settings
from amers.app.main import create_app
from amers.app.web import page
from tests.compose_file import compose, unset_names

ROOT = Path(__file__).parent.parent
COMPOSE = compose({})
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


FIXED = {"database_password_file", "data_folder", "host", "port"}
"""Settings that a container has of its own: where its volume, its secret and its port are."""
OF_A_BUCKET = {"AWS_ENDPOINT_URL", "AWS_REGION", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"}


@pytest.mark.parametrize("name", OWN)
def test_every_setting_can_be_set_without_editing_a_file(name):
    settings = {f"AMERS_{field.upper()}": field for field in Settings.model_fields}
    given = {setting: f"of {setting}" for setting in settings} | dict.fromkeys(OF_A_BUCKET, "x")
    environment = compose(given)["services"][name]["environment"]
    changeable = {setting for setting, field in settings.items() if field not in FIXED} | OF_A_BUCKET
    assert {key for key, value in environment.items() if value == given.get(key)} == changeable
    assert unset_names(name) == changeable - {"AMERS_DATABASE_URL"}, "docker-compose.yml names them all"


def test_what_is_not_set_has_its_default():
    """An empty value would be a wrong one."""
    environment = compose({})["services"]["api"]["environment"]
    assert environment == {
        "AMERS_DATABASE_URL": "postgresql://amers@db/amers",
        "AMERS_DATABASE_PASSWORD_FILE": "/run/secrets/database_password",
    }
    assert set(re.findall(r"\b(AMERS_\w+)=", DOCKERFILE)) == {"AMERS_DATA_FOLDER", "AMERS_HOST"}


def test_the_health_of_the_api_is_asked_at_a_path_it_has():
    program = COMPOSE["services"]["api"]["healthcheck"]["test"]
    assert program[:4] == ["CMD", "python", "-I", "-c"]
    compile(program[4], "healthcheck", "exec")
    (path,) = re.findall(r"http://127\.0\.0\.1:8000(/\w+)", program[4])
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
        (temporary,) = service["tmpfs"]
        assert re.fullmatch(r"/tmp:size=\w+,mode=1777,nosuid,nodev", temporary)
        data |= {volume for volume in service["volumes"]}
    (shared,) = data
    volume, folder = shared.split(":")
    assert volume in COMPOSE["volumes"]
    assert f"AMERS_DATA_FOLDER={folder}" in DOCKERFILE
    (caches,) = re.findall(r"NUMBA_CACHE_DIR=(\S+)", DOCKERFILE)
    assert caches.startswith(folder)


def size_of(text: str) -> int:
    """A size such as `10g`."""
    return int(text[:-1]) << {"m": 20, "g": 30}[text[-1]]


@pytest.mark.parametrize("name", COMPOSE["services"])
def test_every_container_has_limits_and_no_more_rights_than_it_needs(name):
    service = COMPOSE["services"][name]
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert 0 < service["pids_limit"] <= 1024
    assert service["cpus"] == 0, "as many as there are, unless somebody says otherwise"
    assert size_of(service["mem_limit"]) >= 1 << 30
    shared = COMPOSE["services"]["db"]["shm_size"]
    assert size_of(shared.replace("gb", "g")) < size_of(COMPOSE["services"]["db"]["mem_limit"])
    own = compose({"API_CPUS": "1", "WORKER_CPUS": "1", "DATABASE_CPUS": "1"})["services"][name]
    assert own["cpus"] == 1


def test_a_worker_has_the_memory_of_its_job_and_of_its_temporary_files():
    worker = OWN["worker"]
    (size,) = re.findall(r"size=(\w+)", worker["tmpfs"][0])
    needed = Settings.model_fields["job_memory_bytes"].default + size_of(size)
    assert size_of(worker["mem_limit"]) > needed


def test_images_have_exact_tags_and_can_be_pinned_by_their_digests(tmp_path):
    """With a registry at hand; which digest a tag has, this test cannot know."""
    digest = "sha256:" + "0123456789abcdef" * 4
    docker = tmp_path / "docker"
    docker.write_text(f"#!/bin/sh\n[ \"$1 $2 $3\" = 'buildx imagetools inspect' ] && echo {digest}\n")
    docker.chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    pinned = subprocess.run(
        [ROOT / "scripts" / "pin-images"], env=environment, capture_output=True, text=True, check=True
    ).stdout
    variables = dict(line.split("=", 1) for line in pinned.splitlines())
    assert set(variables) == {"NODE_IMAGE", "PYTHON_IMAGE", "POSTGIS_IMAGE"}
    services = compose(variables)["services"]
    arguments = services["api"]["build"]["args"]
    for image in (services["db"]["image"], *arguments.values()):
        assert re.fullmatch(rf"[a-z/]+:[\w.-]+@{digest}", image), image
    defaults = dict(re.findall(r"^ARG (\w+)=(\S+)$", DOCKERFILE, re.MULTILINE))
    assert defaults == COMPOSE["services"]["api"]["build"]["args"]
    froms = re.findall(r"^FROM (\S+)", DOCKERFILE, re.MULTILINE)
    assert {image.strip("${}") for image in froms} == set(defaults)


def test_no_secret_stands_in_the_files_and_only_this_machine_is_listened_to():
    for service in COMPOSE["services"].values():
        assert service["secrets"] == ["database_password"]
        assert not [name for name in service["environment"] if re.search(r"PASSWORD$|SECRET", name)]
    assert COMPOSE["secrets"]["database_password"] == {"file": "./secrets/database_password"}
    assert {"secrets/", ".env"} <= set((ROOT / ".gitignore").read_text().split())
    ports = [port for service in COMPOSE["services"].values() for port in service.get("ports", ())]
    assert ports == ["127.0.0.1:8000:8000"]


def test_what_the_image_copies_is_there_and_not_kept_from_it():
    let_in = [line[1:] for line in (ROOT / ".dockerignore").read_text().split() if line.startswith("!")]
    for line in re.findall(r"^COPY (?!--from)(.*)$", DOCKERFILE, re.MULTILINE):
        *sources, _ = shlex.split(line)
        assert all((ROOT / source).exists() for source in sources), line
        assert all(Path(source).parts[0] in let_in for source in sources), line


def test_the_image_has_the_page_built_where_the_service_looks_for_it():
    (source, target) = re.findall(r"^COPY --from=page (\S+) (\S+)$", DOCKERFILE, re.MULTILINE)[0]
    assert source == f"/build/{target}"
    assert ROOT / target == page.BUILT.resolve()


def test_the_image_installs_the_tested_versions_and_only_files_with_a_known_hash():
    lines = (ROOT / "requirements.txt").read_text()
    required = dict(re.findall(r"^([\w.-]+)==(\S+)", lines, re.MULTILINE))
    hashes = re.findall(
        r"^[\w.-]+==[^\n]+\\\n(?:    --hash=sha256:[0-9a-f]{64}(?: \\)?\n)+", lines, re.MULTILINE
    )
    assert len(hashes) == len(required) > 50
    assert "".join(hashes) == lines, "nothing else stands in the file, no address either"
    tested = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())
    exact = {canonicalize_name(name): version for name, version in tested.items()}
    assert {name: exact.get(name) for name in required} == required


def test_everything_that_amers_needs_to_run_is_required_with_it():
    """`scripts/make-requirements` writes the file anew."""
    required = re.findall(r"^([\w.-]+)==", (ROOT / "requirements.txt").read_text(), re.MULTILINE)
    needed, waiting = set(), [("amers", frozenset[str]())]
    while waiting:
        name, extras = waiting.pop()
        for text in distribution(name).requires or ():
            requirement = Requirement(text)
            wanted = [{"extra": extra} for extra in (extras or {""})]
            if requirement.marker is None or any(requirement.marker.evaluate(one) for one in wanted):
                found = (canonicalize_name(requirement.name), frozenset(requirement.extras))
                if found not in needed:
                    needed.add(found)
                    waiting.append(found)
    assert {name for name, _ in needed} - set(required) == set()
    assert "setuptools" in required, "it builds the package in the image"
