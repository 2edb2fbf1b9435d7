"""Tokens and roles: who may do what, as the documentation tells it, and what is kept of a token."""

import json
import re
import ssl
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from autotuner.cli import main
from autotuner.configuration import state_directory
from autotuner.errors import InputError, StorageError
from autotuner.service.openapi import document
from autotuner.service.security.limits import REMEMBERED, Buckets
from autotuner.service.security.tokens import FILE, Role, Tokens
from tests.control.processes import PATIENCE_S

PATHS = json.loads(document())["paths"]
OPERATIONS = sorted((path, method) for path, methods in PATHS.items() for method in methods)
UNPROTECTED = [("/", "get"), ("/page/{name}", "get")]
WHO = ("no token", "malformed", "revoked", "viewer", "operator")
NAMES = {"{loop}": "absent", "{tuning_id}": "absent", "{name}": "app.js"}


@pytest.fixture
def tokens(configure):
    return Tokens(Path(configure().service.data_directory))


async def answers(client, secrets):
    """Return, for every operation, whether each kind of client passes."""
    table = {}
    for path, method in [*UNPROTECTED, *OPERATIONS]:
        address = path
        for name, value in NAMES.items():
            address = address.replace(name, value)
        for who in WHO:
            headers = {"Authorization": secrets[who]} if who in secrets else {}
            status = (
                await client.request(method, address, headers=headers, json={} if method == "post" else None)
            ).status_code
            table[path, method, who] = status not in {401, 403}
            assert status < 500, (path, method, who)
    return table


@pytest.mark.virtual_time
async def test_the_access_matrix_is_that_of_the_documentation(serving, configure, root_folder):
    configuration = configure(requests_per_s=1e6)
    tokens = Tokens(Path(configuration.service.data_directory))
    secrets = {
        "malformed": "Bearer",
        "revoked": f"Bearer {tokens.add('former', Role.OPERATOR)}",
        "viewer": f"Bearer {tokens.add('screen', Role.VIEWER)}",
        "operator": f"Bearer {tokens.add('engineer', Role.OPERATOR)}",
    }
    tokens.revoke("former")
    async with serving(configuration) as service:
        table = await answers(service.client, secrets)
    lines = [
        f"| `{method.upper()} {path}` | "
        + " | ".join("yes" if table[path, method, who] else "no" for who in WHO)
        + " |"
        for path, method in [*UNPROTECTED, *OPERATIONS]
    ]
    page = (root_folder / "docs" / "access.md").read_text(encoding="utf-8")
    documented = re.findall(r"^\| `[A-Z]+ /.*$", page, re.MULTILINE)
    assert documented == lines, "the table should be:\n" + "\n".join(lines)


@pytest.mark.virtual_time
async def test_no_operation_passes_when_the_tokens_are_lost(serving, configure):
    """Every operation of the document but those that need no token, for every kind of client."""
    configuration = configure(requests_per_s=1e6)
    tokens = Tokens(Path(configuration.service.data_directory))
    bearers = [{}, *({"Authorization": f"Bearer {tokens.add(role, role)}"} for role in Role)]
    async with serving(configuration) as service:
        assert (await service.client.get("/v1/loops", headers=bearers[1])).status_code == 200
        tokens._path.unlink()
        for path, method in OPERATIONS:
            address = re.sub("{[a-z_]+}", "heater", path)
            for headers in bearers:
                status = (await service.client.request(method, address, headers=headers)).status_code
                assert status == (200 if path in {"/healthz", "/v1/problems"} else 507), (path, method, headers)
        assert service.manager.tunings == {}


@pytest.fixture
def root_folder(request):
    return request.config.rootpath


@pytest.mark.virtual_time
async def test_a_token_that_is_revoked_is_worth_nothing_from_the_next_request_on(serving, tokens, check_problem):
    secret = tokens.add("engineer", Role.OPERATOR)
    async with serving() as service:
        bearer = {"Authorization": f"Bearer {secret}"}
        assert (await service.client.get("/v1/loops", headers=bearer)).status_code == 200
        tokens.revoke("engineer")
        answer = await service.client.get("/v1/loops", headers=bearer)
        assert answer.headers["www-authenticate"] == "Bearer"
        check_problem(answer, 401, "no-token")


@pytest.mark.virtual_time
async def test_without_tokens_this_machine_is_served(serving):
    async with serving() as service:
        assert (await service.client.get("/v1/loops")).status_code == 200


def test_a_secret_is_kept_nowhere(tokens, configure):
    secret = tokens.add("engineer", Role.OPERATOR)
    file = tokens._path
    assert secret not in file.read_text(encoding="utf-8")
    assert file.stat().st_mode & 0o077 == 0
    assert tokens.holder(secret).name == "engineer"
    assert Tokens(file.parent).holder(secret + "x") is None


def test_a_name_is_given_once(tokens):
    tokens.add("engineer", Role.OPERATOR)
    tokens.revoke("engineer")
    with pytest.raises(InputError, match="another token"):
        tokens.add("engineer", Role.OPERATOR)
    with pytest.raises(InputError, match="no valid token"):
        tokens.revoke("engineer")


@pytest.mark.parametrize("content", ["", "{}x", '[{"name": "a"}]', '[{"role": "king"}]'])
def test_a_damaged_file_lets_nobody_in(tmp_path, content):
    (tmp_path / FILE).write_text(content, encoding="utf-8")
    with pytest.raises(StorageError, match="cannot be used"):
        _ = Tokens(tmp_path).required


@pytest.mark.virtual_time
async def test_a_damaged_file_is_told_to_whoever_asks(serving, tokens, check_problem):
    async with serving() as service:
        tokens._path.parent.mkdir(parents=True, exist_ok=True)
        tokens._path.write_text("{", encoding="utf-8")
        check_problem(await service.client.get("/v1/loops"), 507, "storage-error")


def test_tokens_from_the_shell(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["token", "add", "screen", "--role", "viewer"]) == 0
    secret = capsys.readouterr().out.strip()
    assert len(secret) >= 40
    assert main(["token", "list"]) == 0
    assert capsys.readouterr().out.startswith("screen: viewer, made ")
    assert main(["token", "revoke", "screen"]) == 0
    assert main(["token", "revoke", "nobody"]) == 2
    assert Tokens(Path(state_directory())).holder(secret) is None


@pytest.mark.virtual_time
async def test_a_start_that_is_sent_twice_is_done_once(serving, check_problem):
    key = {"Idempotency-Key": "f2b1c9e0-aaaa"}
    async with serving() as service:
        path = "/v1/loops/heater/tunings"
        first = await service.client.post(path, headers=key, json={"goal": "calm"})
        again = await service.client.post(path, headers=key, json={"goal": "calm"})
        assert (first.status_code, again.status_code) == (202, 202)
        assert first.headers["location"] == again.headers["location"]
        assert len(service.manager.tunings) == 1
        check_problem(await service.client.post(path, headers=key, json={"goal": "brisk"}), 422, "unusable-value")


@pytest.mark.virtual_time
async def test_a_client_that_asks_without_end_is_slowed(serving, configure, check_problem):
    async with serving(configure(requests_per_s=0.5)) as service:
        codes = [(await service.client.get("/v1/loops")).status_code for _ in range(6)]
        assert codes == [200] * 5 + [429]
        answer = await service.client.get("/v1/loops")
        assert answer.headers["retry-after"] == "2"
        check_problem(answer, 429, "too-many-requests")


def test_buckets_fill_with_time_and_are_bounded():
    buckets = Buckets(2.0, 3.0)
    assert [buckets.wait_s("a", 0.0) for _ in range(4)] == [0.0, 0.0, 0.0, 0.5]
    assert buckets.wait_s("a", 0.5) == 0.0
    assert buckets.wait_s("b", 0.5) == 0.0
    for number in range(2 * REMEMBERED):
        buckets.wait_s(str(number), 1.0)
    assert len(buckets._levels) == REMEMBERED


@pytest.mark.virtual_time
@pytest.mark.parametrize("path", ["/", "/v1/loops", "/v1/absent", "/page/app.js"])
async def test_every_answer_has_the_secure_headers(serving, path):
    async with serving() as service:
        headers = (await service.client.get(path)).headers
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["x-frame-options"] == "DENY"
    assert headers["referrer-policy"] == "no-referrer"
    assert "default-src 'none'" in headers["content-security-policy"]


@pytest.mark.realtime
def test_https_by_certificate_files(tmp_path):
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    made = subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", certificate, "-days", "2",
         "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"],
        capture_output=True, check=False,
    )  # fmt: skip
    if made.returncode:
        pytest.skip("no certificate can be made here: openssl is missing")
    text = f'[service]\ncertificate = "{certificate}"\nprivate_key = "{key}"\n[loops.a]\ndriver = "simulated"\n'
    text += 'device = { plant = { structure = "fopdt", K = 1.0, T = 1.0, D = 0.1 } }\n'
    (tmp_path / "autotuner.toml").write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "autotuner.cli", "serve", "--json", "--port", "0"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as server:
        address = json.loads(server.stdout.readline())["listening"]
        assert address.startswith("https://")
        trust = ssl.create_default_context(cafile=certificate)
        with httpx.Client(base_url=address, verify=trust, timeout=PATIENCE_S) as client:
            assert client.get("/healthz").status_code == 200
            foreign = client.post("/v1/loops/a/tunings", headers={"Origin": address.replace("https", "http")})
            assert foreign.status_code == 403
        server.terminate()


@pytest.mark.parametrize(
    ("lines", "field"),
    [
        ('certificate = "absent.pem"\nprivate_key = "absent.pem"', "certificate"),
        ('certificate = "a.pem"', "private_key"),
    ],
)
def test_a_certificate_that_cannot_be_used_is_refused(tmp_path, monkeypatch, capsys, lines, field):
    monkeypatch.chdir(tmp_path)
    device = 'device = { plant = { structure = "fopdt", K = 1.0, T = 1.0, D = 0.1 } }'
    (tmp_path / "autotuner.toml").write_text(
        f'[service]\n{lines}\n[loops.a]\ndriver = "simulated"\n{device}\n', encoding="utf-8"
    )
    assert main(["serve", "--json", "--port", "0"]) == 2
    assert f"service.{field}" in capsys.readouterr().err
