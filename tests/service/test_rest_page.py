"""docs/rest.md, line by line: each request is sent, in the order of the page, and answered with the status it tells."""

import re
import shlex

import pytest

from autotuner.configuration import DEMO

pytestmark = pytest.mark.virtual_time

ADDRESS = "127.0.0.1:8321"


def requests_of(page):
    """Yield method, path, headers, body and the status told of every curl line."""
    for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL):
        for line in block.splitlines():
            if line.startswith("curl"):
                yield request_of(line)


def request_of(line):
    command, _, told = line.rpartition("    # ") if "    # " in line else line.rpartition(" # ")
    words = iter(shlex.split(command)[1:])
    method, headers, body, path = "GET", {}, None, None
    for word in words:
        if word == "-X":
            method = next(words)
        elif word == "-H":
            name, _, value = next(words).partition(": ")
            headers[name] = value
        elif word == "-d":
            method, body = "POST", next(words)
        elif not word.startswith("-"):
            path = word.removeprefix(ADDRESS)
    return method, path, headers, body, int(told[:3])


async def test_every_line_is_answered_as_the_page_tells(serving, configure, pytestconfig):
    page = (pytestconfig.rootpath / "docs" / "rest.md").read_text(encoding="utf-8")
    sent, identifier = 0, None
    async with serving(configure(DEMO["loops"])) as service:
        for method, path, headers, body, status in requests_of(page):
            place = path.replace("$ID", identifier or "")
            answer = await service.client.request(method, place, headers=headers, content=body)
            assert answer.status_code == status, f"{method} {path}: {answer.text[:500]}"
            if "location" in answer.headers:
                identifier = answer.headers["location"].rpartition("/")[2]
            if path.endswith("/verify") and status == 200:
                assert answer.json()["passed"] is True
            sent += 1
    assert sent >= 25
