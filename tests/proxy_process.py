"""nginx and Caddy in front of a service, as the examples of the documentation configure them."""

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import IPv4Address
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from tests.service_process import until

EXAMPLES = Path(__file__).parents[1] / "examples" / "proxy"
HOST = "127.0.0.1"
NGINX = """
daemon off;
worker_processes 1;
pid FOLDER/nginx.pid;
error_log FOLDER/error.log;
USER
events { worker_connections 256; }
http {
    access_log off;
    client_body_temp_path FOLDER/body;
    proxy_temp_path FOLDER/proxy;
    fastcgi_temp_path FOLDER/fastcgi;
    uwsgi_temp_path FOLDER/uwsgi;
    scgi_temp_path FOLDER/scgi;
SITE
}
"""
CADDY = "{\n\tadmin off\n\tauto_https off\n}\n"


@dataclass(frozen=True)
class Certificate:
    """A certificate that signs itself, of the address 127.0.0.1.

    Attributes:
        path: the certificate, which a client has to trust.
        key: its private key.
    """

    path: Path
    key: Path


@dataclass(frozen=True)
class Ports:
    """Ports of a proxy for TLS and without, and of the service behind it."""

    tls: int
    plain: int
    service: int


def make_certificate(folder: Path) -> Certificate:
    """A new certificate, valid for a day."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "a proxy of the tests")])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(IPv4Address(HOST))]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    made = Certificate(folder / "certificate.pem", folder / "key.pem")
    made.path.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    made.key.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )
    return made


@contextmanager
def nginx(folder: Path, certificate: Certificate, ports: Ports, *, removes_path: bool) -> Iterator[None]:
    """nginx with the site of the example; it removes the public path from requests or passes it on."""
    program = program_of("nginx", "make proxies")
    end = "/" if removes_path else ""
    site = replaced(
        (EXAMPLES / "nginx.conf").read_text(),
        {
            "/etc/ssl/certs/gcp.example.org.pem": str(certificate.path),
            "/etc/ssl/private/gcp.example.org.key": str(certificate.key),
            "listen 80;": f"listen {HOST}:{ports.plain};",
            "listen 443 ssl": f"listen {HOST}:{ports.tls} ssl",
            "server_name gcp.example.org": f"server_name {HOST}",
            "proxy_pass http://127.0.0.1:8000;": f"proxy_pass http://{HOST}:{ports.service}{end};",
        },
    )
    user = "user root;" if os.geteuid() == 0 else ""
    configuration = folder / "nginx.conf"
    configuration.write_text(
        NGINX.replace("SITE", site).replace("FOLDER", str(folder)).replace("USER", user)
    )
    command = [program, "-p", str(folder), "-e", str(folder / "error.log"), "-c", str(configuration)]
    with running(command, folder, ports):
        yield


@contextmanager
def caddy(folder: Path, certificate: Certificate, ports: Ports) -> Iterator[None]:
    """Caddy with the site of the example, and a certificate that it need not get."""
    program = program_of("caddy", "apt-get install caddy")
    site = replaced(
        (EXAMPLES / "Caddyfile").read_text(),
        {
            "\ngcp.example.org {": (
                f"\nhttps://{HOST}:{ports.tls} {{\n\ttls {certificate.path} {certificate.key}"
            ),
            "reverse_proxy 127.0.0.1:8000": f"reverse_proxy {HOST}:{ports.service}",
        },
    )
    configuration = folder / "Caddyfile"
    configuration.write_text(CADDY + site)
    with running(
        [program, "run", "--adapter", "caddyfile", "--config", str(configuration)], folder, ports
    ):
        yield


def program_of(name: str, installed_by: str) -> str:
    """The path of a program; the test is skipped where it is missing."""
    path = shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin")
    if path is None:
        pytest.skip(f"there is no {name}: the service is not tried behind it: run `{installed_by}`")
    return path


def replaced(text: str, values: dict[str, str]) -> str:
    """A text with other values; each has to be there."""
    for former, present in values.items():
        assert former in text, former
        text = text.replace(former, present)
    return text


@contextmanager
def running(command: list[str], folder: Path, ports: Ports) -> Iterator[None]:
    """A proxy that listens, and is stopped at the end."""
    environment = {**os.environ, "HOME": str(folder), "XDG_DATA_HOME": str(folder)}
    with (folder / "output").open("wb") as output:
        process = subprocess.Popen(command, env=environment, stdout=output, stderr=output)
    try:
        assert until(lambda: listens(ports.tls) or process.poll() is not None)
        assert process.poll() is None, (folder / "output").read_text()
        yield
    finally:
        process.terminate()
        process.wait(30)


def listens(port: int) -> bool:
    with suppress(OSError), socket.create_connection((HOST, port), timeout=5):
        return True
    return False
