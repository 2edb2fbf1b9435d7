"""The page at `/`: plain HTML, style sheet and JavaScript modules, served from the installed package.

Invariants:

1. Nothing is built and nothing is loaded from elsewhere: the page works in a plant without internet.
2. The files are read once, when the service starts, so that no request waits for a disk.
3. Headers forbid the browser to run anything that is not a file of ours: no inline script, no inline style, no frame.
"""

from __future__ import annotations

import hashlib
from importlib.resources import files
from typing import TYPE_CHECKING, Annotated

from fastapi import APIRouter, Header, Response
from starlette.exceptions import HTTPException

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of the page."""

router = APIRouter(include_in_schema=False)


def _read(folder: Traversable, prefix: str = "") -> dict[str, bytes]:
    found: dict[str, bytes] = {}
    for entry in folder.iterdir():
        if entry.is_dir():
            found |= _read(entry, f"{prefix}{entry.name}/")
        else:
            found[prefix + entry.name] = entry.read_bytes()
    return found


FILES = _read(files(__package__) / "static")
"""The page's files by their path below `/page/`."""
VERSION = f'"{hashlib.sha256(b"".join(FILES[name] for name in sorted(FILES))).hexdigest()[:16]}"'
"""Shows a browser whether its copy is still the same."""


@router.get("/")
async def page() -> Response:
    """Return the page."""
    return _file("index.html")


@router.get("/page/{name:path}")
async def page_file(name: str, if_none_match: Annotated[str, Header()] = "") -> Response:
    """Return one of the page's files."""
    if name not in FILES:
        raise HTTPException(404, "the page has no such file")
    return Response(status_code=304, headers={"ETag": VERSION}) if if_none_match == VERSION else _file(name)


def _file(name: str) -> Response:
    media_type = MEDIA_TYPES[name[name.rindex(".") :]]
    headers = {"Content-Security-Policy": POLICY, "Cache-Control": "no-cache", "ETag": VERSION}
    return Response(FILES[name], media_type=media_type, headers=headers)
