"""The API document: `python -m autotuner.service.openapi > docs/openapi.json` writes the committed one."""

from __future__ import annotations

import json
import sys

from autotuner.service.app import bare_app


def document() -> str:
    """Return the OpenAPI document as JSON text."""
    return json.dumps(bare_app().openapi(), indent=1) + "\n"


if __name__ == "__main__":
    sys.stdout.write(document())
