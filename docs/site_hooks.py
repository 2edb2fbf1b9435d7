"""Hooks of the documentation site.

A mermaid diagram is shown as its picture, so that no script has to be loaded. A file of the repository that a page
links to becomes a part of the site, so that the link leads somewhere there too.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from properdocs.structure.files import Files

DIAGRAM = re.compile(r"^```mermaid\n(?P<source>.*?)^```$", re.DOTALL | re.MULTILINE)
"""A diagram in the text of a page."""
LINK = re.compile(r"(?<=\]\()[\w.][\w./-]*\w(?=\))")
"""The target of a link, without a place in the page."""
DOCS = Path(__file__).parent
REPOSITORY = "repository"
"""Folder of the site for files of the repository."""


def picture_of(stem: str) -> str:
    """Return the picture of the diagram of a page, relative to the folder of the pages."""
    return f"images/diagrams/{stem}.svg"


def source_hash(source: str) -> str:
    """Return the SHA-256 of a diagram, which its picture carries."""
    return hashlib.sha256(source.encode()).hexdigest()


def outside(page: str, target: str) -> str | None:
    """Return the file of the repository that a link of a page leads to; nothing where it is no such file.

    Parameters
    ----------
    page : str
        Path of the page, relative to the folder of the pages.
    target : str
        Target of the link, as the page has it.
    """
    path = (DOCS / page).parent.joinpath(target).resolve()
    is_outside = path.is_file() and path.is_relative_to(DOCS.parent) and not path.is_relative_to(DOCS)
    return path.relative_to(DOCS.parent).as_posix() if is_outside else None


def linked_files(texts: dict[str, str]) -> set[str]:
    """Return the files of the repository that pages link to, and what those link to that are pages themselves.

    Parameters
    ----------
    texts : dict of str to str
        Text of each page by its path, relative to the folder of the pages.
    """
    files: set[str] = set()
    while texts:
        found = {file for page, text in texts.items() for link in LINK.findall(text) if (file := outside(page, link))}
        pages = [file for file in found - files if file.endswith(".md")]
        texts = {f"../{file}": (DOCS.parent / file).read_text(encoding="utf-8") for file in pages}
        files |= found
    return files


def on_files(files: Files, config: Any) -> Files:
    """Add each file of the repository that a page links to."""
    from properdocs.structure.files import File  # noqa: PLC0415 - tests read this module without it

    pages = {file.src_uri: file.content_string for file in files if file.is_documentation_page()}
    for path in sorted(linked_files(pages)):
        files.append(File.generated(config, f"{REPOSITORY}/{path}", abs_src_path=str(DOCS.parent / path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replace each diagram of a page by its picture, and lead each link out of the pages to its file in the site."""
    path = PurePosixPath(page.file.src_uri)

    def inside(link: re.Match[str]) -> str:
        file = None if path.parts[0] == REPOSITORY else outside(str(path), link[0])
        return link[0] if file is None else os.path.relpath(f"{REPOSITORY}/{file}", path.parent)

    place = os.path.relpath(picture_of(path.stem), path.parent)
    return DIAGRAM.sub(f"![Diagram]({place})", LINK.sub(inside, markdown))
