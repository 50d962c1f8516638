"""The map page: files built by `make page`, under a content security policy.

The policy allows no other site, except that of the background of the map where a setting names one.
"""

from email.utils import formatdate
from mimetypes import guess_type
from pathlib import Path
from urllib.parse import urlsplit

from fastapi import APIRouter, Request, Response
from fastapi.responses import RedirectResponse
from pydantic import BaseModel

from amers.app.api.conditions import tag_of
from amers.app.api.paths import SLASH
from amers.app.api.routes import CallerRoute
from amers.app.config import Settings
from amers.app.errors import NotFound

router = APIRouter(include_in_schema=False, route_class=CallerRoute)

BUILT = Path(__file__).parent / "built"
POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "worker-src 'self'",
        "connect-src 'self'{background}",
        "img-src 'self' blob: data:",
        # A report that the page opens inherits this policy; its styles are inside it.
        "style-src 'self' 'unsafe-inline'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-cache",
    "Vary": "Accept-Encoding",
}


class Background(BaseModel):
    """The background of the map.

    Attributes:
        tiles: address with places `{z}`, `{x}` and `{y}`; None for land only.
        attribution: who made it; None without tiles.
    """

    tiles: str | None
    attribution: str | None


@router.get("/map")
def page(request: Request) -> Response:
    """Return the page, whose links lead beside it: at `/map/` they would lead below it."""
    if SLASH in request.scope:
        return RedirectResponse(f"{request.base_url}map")
    return _file(request, "index.html")


@router.get("/map/background.json")
def background(request: Request) -> Background:
    """Return the background of the map that the operator has chosen."""
    settings: Settings = request.app.state.settings
    return Background(tiles=settings.map_background, attribution=settings.map_background_attribution)


@router.get("/map/{name}")
def part(name: str, request: Request) -> Response:
    """Return a file of the page."""
    return _file(request, name)


def policy(settings: Settings) -> str:
    """The content security policy of the page of an installation."""
    parts = urlsplit(settings.map_background or "")
    return POLICY.format(background=f" https://{parts.netloc}" if parts.netloc else "")


def _file(request: Request, name: str) -> Response:
    """A file of the page, compressed if the browser accepts that.

    Raises:
        NotFound: the page has no such file, or is not built in this installation.
    """
    if not (BUILT / "index.html").is_file():
        raise NotFound("the page is not built in this installation: run `make page` where Node.js is")
    if name not in {file.name for file in BUILT.iterdir() if file.suffix != ".gz"}:
        raise NotFound(f"the page has no file {name:.100}")
    headers = {"Content-Security-Policy": policy(request.app.state.settings), **HEADERS}
    path = BUILT / name
    if "gzip" in request.headers.get("accept-encoding", ""):
        path = BUILT / f"{name}.gz"
        headers["Content-Encoding"] = "gzip"
    content = path.read_bytes()
    headers["ETag"] = tag_of(content)
    headers["Last-Modified"] = formatdate(path.stat().st_mtime, usegmt=True)
    kind = guess_type(name)[0] or "application/octet-stream"
    return Response(content, media_type=kind, headers=headers)
