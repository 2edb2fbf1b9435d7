"""Draw the mermaid diagrams of the pages as SVG, for the site: a reader without internet sees pictures, not sources.

    npm install mermaid
    python docs/make_diagrams.py node_modules/mermaid/dist/mermaid.min.js

A headless Chromium draws each diagram. The picture of PAGE.md is images/diagrams/PAGE.svg, with the SHA-256 of its
source; `docs/site_hooks.py` shows it in place of the source, and a test compares the hashes.
"""

from __future__ import annotations

import argparse
import html
import re
import subprocess
import tempfile
from pathlib import Path

from make_pictures import browser_module
from site_hooks import DIAGRAM, picture_of, source_hash

DOCS = Path(__file__).resolve().parent
PAGE = """<!doctype html><meta charset="utf-8"><body><pre class="mermaid">{source}</pre>
<script src="{library}"></script>
<script>
mermaid.initialize({{htmlLabels: false, flowchart: {{htmlLabels: false}}, theme: "neutral", deterministicIds: true}});
</script>
"""
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=20000", "--dump-dom")
LONGEST_DRAWING_S = 120.0


def drawn(source: str, library: Path) -> str:
    """Return the SVG of a diagram, as Chromium draws it."""
    program = browser_module().find()
    if program is None:
        raise SystemExit("no Chromium is installed")
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        page.write_text(PAGE.format(source=html.escape(source), library=library.resolve().as_uri()), encoding="utf-8")
        command = [program, *FLAGS, f"--user-data-dir={folder}/profile", page.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=LONGEST_DRAWING_S)  # noqa: S603
    found = re.search(r"<svg.*</svg>", done.stdout, re.DOTALL)
    if found is None:
        raise SystemExit(f"Chromium drew nothing of:\n{source}")
    widest = re.search(r"max-width: ([\d.]+)px", found[0])
    width = f"{float(widest[1]):.0f}" if widest else "100%"
    return found[0].replace("<br>", "<br/>").replace('width="100%"', f'width="{width}"', 1)


def main() -> None:
    """Draw the diagram of each page that has one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("library", type=Path, metavar="MERMAID.js")
    args = parser.parse_args()
    for page in sorted(DOCS.rglob("*.md")):
        for found in DIAGRAM.finditer(page.read_text(encoding="utf-8")):
            source = found["source"]
            picture = DOCS / picture_of(page.stem)
            picture.parent.mkdir(exist_ok=True)
            picture.write_text(f"<!-- {source_hash(source)} -->\n{drawn(source, args.library)}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
