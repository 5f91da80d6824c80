"""The built page: its files are read once, so that a path in a request is a key and never a path."""

from __future__ import annotations

import hashlib
import mimetypes
from dataclasses import dataclass
from pathlib import Path

from fastapi import APIRouter, HTTPException, Request, Response

router = APIRouter()
_TYPES = {".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8", ".html": "text/html; charset=utf-8"}


@dataclass(frozen=True)
class File:
    """A file of the page."""

    content: bytes
    kind: str
    tag: str
    lasting: bool


def read(folder: Path) -> dict[str, File]:
    """Every file below a folder, by its path in requests."""
    files = {}
    for path in sorted(folder.rglob("*")) if folder.is_dir() else []:
        if path.is_file() and not path.is_symlink():
            name, content = path.relative_to(folder).as_posix(), path.read_bytes()
            kind = _TYPES.get(path.suffix) or mimetypes.guess_type(name)[0] or "application/octet-stream"
            tag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
            files["/" + name] = File(content, kind, tag, name.startswith("assets/"))
    if "/index.html" in files:
        files["/"] = files["/index.html"]
    return files


@router.api_route("/{path:path}", methods=["GET", "HEAD"])
def page(request: Request, path: str) -> Response:
    """A file of the page."""
    file: File | None = request.app.state.files.get("/" + path)
    if file is None:
        raise HTTPException(404, "there is nothing here")
    # Names under assets/ contain a hash of what is in them.
    cache = "public, max-age=31536000, immutable" if file.lasting else "no-cache"
    headers = {"etag": file.tag, "cache-control": cache}
    if request.headers.get("if-none-match") == file.tag:
        return Response(status_code=304, headers=headers)
    return Response(file.content, media_type=file.kind, headers=headers)
