"""Hooks of the documentation site: a mermaid diagram is shown as its picture, so that no script has to be loaded."""

from __future__ import annotations

import hashlib
import re
from pathlib import PurePosixPath
from typing import Any

DIAGRAM = re.compile(r"^```mermaid\n(?P<source>.*?)^```$", re.DOTALL | re.MULTILINE)
"""A diagram in the text of a page."""


def picture_of(stem: str) -> str:
    """Return the picture of the diagram of a page, relative to the folder of the pages."""
    return f"images/diagrams/{stem}.svg"


def source_hash(source: str) -> str:
    """Return the SHA-256 of a diagram, which its picture carries."""
    return hashlib.sha256(source.encode()).hexdigest()


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replace each diagram of a page by its picture."""
    path = PurePosixPath(page.file.src_uri)
    place = "../" * (len(path.parts) - 1) + picture_of(path.stem)
    return DIAGRAM.sub(f"![Diagram]({place})", markdown)
