"""Generates the synchronous client from the asynchronous one: `python -m autotuner.client.generate`.

Only `asynchronous` is edited. The replacements below are the only differences between the two; a test
compares the committed file with the result of this module.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).with_name("asynchronous.py")
TARGET = Path(__file__).with_name("synchronous.py")
REPLACEMENTS = {
    r'^"""The asynchronous client.*': (
        '"""The synchronous client, which `autotuner.client.generate` makes of `asynchronous`: edit that one."""'
    ),
    r"AsyncGenerator\[dict\[str, Any\], None\]": "Generator[dict[str, Any], None, None]",
    r"\bAsync(?=[A-Z])": "",
    r"\basync ": "",
    r"\bawait ": "",
    r"\baclosing\b": "closing",
    r"\b__a(enter|exit)__\b": r"__\1__",
    r"\.a(close|read|iter_lines)\(": r".\1(",
}
"""Regular expressions of the asynchronous client, and their replacements, in this order."""


def synchronous() -> str:
    """Return the text of the synchronous client, formatted by ruff."""
    text = SOURCE.read_text(encoding="utf-8")
    for pattern, replacement in REPLACEMENTS.items():
        text = re.sub(pattern, replacement, text)
    fixed = _ruff(text, "check", "--fix", "--unsafe-fixes", "--select", "I,UP028")
    return _ruff(fixed, "format")


def _ruff(text: str, *arguments: str) -> str:
    command = [sys.executable, "-m", "ruff", *arguments, "--quiet", "--stdin-filename", str(TARGET), "-"]
    return subprocess.run(command, input=text, capture_output=True, text=True, check=True).stdout  # noqa: S603


if __name__ == "__main__":
    TARGET.write_text(synchronous(), encoding="utf-8")
