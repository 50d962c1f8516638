"""The compose file as `docker compose` reads it: variables replaced by those of an environment."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "docker-compose.yml").read_text()
VARIABLE = re.compile(r"\$(?:(\$)|\{(\w+)(?::-([^}]*))?\})")


def compose(environment: Mapping[str, str]) -> dict[str, Any]:
    """The services, volumes and secrets under an environment."""
    document = yaml.safe_load(VARIABLE.sub(lambda found: _value(found, environment), TEXT))
    for service in document["services"].values():
        variables = service.get("environment", {})
        service["environment"] = {
            name: environment[name] if value is None else value
            for name, value in variables.items()
            if value is not None or name in environment
        }
    return dict(document)


def unset_names(service: str) -> set[str]:
    """The variables of a service that it takes from the environment under the same name."""
    variables = yaml.safe_load(TEXT)["services"][service]["environment"]
    return {name for name, value in variables.items() if value is None}


def image_environment() -> dict[str, str]:
    """The variables that the Dockerfile sets."""
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    (line,) = re.findall(r"^ENV (.*)$", text, re.MULTILINE)
    return dict(word.split("=", 1) for word in line.split())


def _value(found: "re.Match[str]", environment: Mapping[str, str]) -> str:
    dollar, name, default = found.groups()
    return "$" if dollar else environment.get(name) or default or ""
