"""Input that nobody should send: a clear refusal, never a traceback, a 500 or a heap of memory."""

import asyncio
import tracemalloc

import pytest

from autotuner.cli import main
from autotuner.configuration import load_configuration
from autotuner.errors import ConfigurationError, RecordingError
from autotuner.service.computations import MOST_COLUMNS, identify_csv, refuses_absurd_numbers
from autotuner.service.schemas.requests import IdentificationChoice

CHOICE = IdentificationChoice()
START = "/v1/loops/heater/tunings"


@pytest.mark.parametrize(
    "text", ["a = " + "[" * 100_000, "a = " + "{b=" * 50_000, "a = " + "9" * 5000, "\0", "a = 1\na = 2", "[" * 10_000]
)
def test_a_configuration_that_is_no_toml_is_refused_with_a_sentence(tmp_path, text):
    (tmp_path / "loops.toml").write_text(text)
    with pytest.raises(ConfigurationError):
        load_configuration(tmp_path / "loops.toml")


def test_a_value_that_is_nested_too_deeply_to_be_shown_is_refused_with_a_sentence():
    value = []
    for _ in range(100_000):
        value = [value]
    assert "nested too deeply" in str(ConfigurationError("is no number", field="a", value=value, remedy="Give one."))


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    "body",
    [
        rb'{"structure": "\ud800"}',
        rb'{"\udfff": 1}',
        b'{"structure": ' + b"[" * 20_000,
        b'{"accuracy": 1e999}',
        b'{"accuracy": ' + b"9" * 5000 + b"}",
        b"\xff\xfe",
    ],
)
async def test_odd_json_is_a_problem_and_never_a_500(serving, body):
    async with serving() as service:
        answer = await service.client.post(START, content=body, headers={"Content-Type": "application/json"})
    assert 400 <= answer.status_code < 500, answer.text
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("content", [b"," * 31_000_000, b"t,u,y" + b"," * 2 * MOST_COLUMNS + b"\n1,2,3\n"])
def test_a_table_of_separators_is_refused_before_it_takes_memory(content):
    tracemalloc.start()
    try:
        with pytest.raises(RecordingError, match=r"has more than \d+ (cells|columns)"):
            identify_csv(content, CHOICE.columns(), "auto", None, CHOICE.spec())
        assert tracemalloc.get_traced_memory()[1] < 1e6 + len(content)
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("error", [OverflowError, ZeroDivisionError, MemoryError])
def test_numbers_that_cannot_be_computed_with_are_refused(error):
    @refuses_absurd_numbers
    def compute():
        raise error

    with pytest.raises(RecordingError, match=error.__name__):
        compute()


PLC = """
[loops.TIC-101]
driver = "modbus"
sample_time_s = {sample_time_s}
{limits}
[loops.TIC-101.device]
host = "127.0.0.1"
[loops.TIC-101.device.registers]
pv = {{ table = "input", address = 0 }}
output = {{ table = "holding", address = 0 }}
"""
BOTH = "limits = { output = [0.0, 100.0], pv = [0.0, 200.0] }"


@pytest.mark.parametrize(
    ("sample_time_s", "limits", "wrong"),
    [
        (0.1, BOTH, None),
        (0.1, "", "limits.output"),
        (0.1, "limits = { output = [0.0, 100.0] }", "limits.pv"),
        (1e-9, BOTH, "sample_time_s"),
        (1e9, BOTH, "sample_time_s"),
    ],
)
def test_check_refuses_a_real_loop_without_limits_and_absurd_sample_times(
    tmp_path, monkeypatch, capsys, sample_time_s, limits, wrong
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loops.toml").write_text(PLC.format(sample_time_s=sample_time_s, limits=limits))
    code = main(["check", "loops.toml"])
    assert code == (2 if wrong else 0), capsys.readouterr().err
    assert wrong is None or wrong in capsys.readouterr().err


@pytest.mark.virtual_time
async def test_an_idempotency_key_survives_a_kill(serving, configure, check_problem):
    """Also one between the key and the start: the tuning is started then, under the identifier that was written."""
    configuration, key = configure(), {"Idempotency-Key": "commissioning-1"}
    async with serving(configuration) as service:
        first = (await service.client.post(START, headers=key)).json()["id"]
        await service.client.post(f"/v1/tunings/{first}/abort")
        await service.app.state.archive.flush()
    async with serving(configuration) as service:
        assert (await service.client.post(START, headers=key)).json()["id"] == first
        assert service.manager.tunings == {}
        other = await service.client.post(START, headers=key, json={"goal": "calm"})
        check_problem(other, 422, "unusable-value")


@pytest.mark.virtual_time
async def test_a_start_that_was_killed_before_it_began_is_begun_by_the_same_request(serving, configure, monkeypatch):
    configuration, key = configure(), {"Idempotency-Key": "commissioning-2"}
    async with serving(configuration, raise_app_exceptions=False) as service:
        monkeypatch.setattr(type(service.manager), "start", lambda *_, **__: 1 / 0)
        assert (await service.client.post(START, headers=key)).status_code == 500
        monkeypatch.undo()
    async with serving(configuration) as service:
        assert (await service.client.post(START, headers=key)).status_code == 202
        assert list(service.manager.tunings) == ["tuning-1"]


@pytest.mark.virtual_time
@pytest.mark.parametrize("damage", ["DROP TABLE events", "UPDATE schema_version SET version = 999"])
async def test_metrics_and_readiness_agree_on_a_damaged_store(serving, check_problem, damage):
    async with serving() as service:
        assert "store_up 1.0" in (await service.client.get("/metrics")).text
        archive = service.app.state.archive
        with archive._opened()._engine.transaction(writing=True) as connection:
            connection.rows(damage)
        archive._close()
        check_problem(await service.client.get("/readyz"), 507, "storage-error")
        assert "store_up 0.0" in (await service.client.get("/metrics")).text
        check_problem(await service.client.post(START), 507, "storage-error")


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE tunings SET told = '{\"model\": '",
        "UPDATE tunings SET request = '[['",
        "UPDATE events SET data = 'x'",
        "UPDATE recording_chunks SET samples = x'0102'",
    ],
)
async def test_a_damaged_record_is_a_507_and_the_others_can_be_exported(serving, configure, check_problem, damage):
    configuration = configure()
    async with serving(configuration) as service:
        for loop in ("heater", "furnace"):
            path = (await service.client.post(f"/v1/loops/{loop}/tunings")).headers["location"]
            await asyncio.sleep(30.0)
            await service.client.post(f"{path}/abort")
            await asyncio.sleep(30.0)
    async with serving(configuration) as service:
        with service.app.state.archive._opened()._engine.transaction(writing=True) as connection:
            connection.rows(f"{damage} WHERE {'id' if 'UPDATE tunings' in damage else 'tuning_id'} = 'tuning-1'")
        for part in ("", "/export", "/recording"):
            told = check_problem(await service.client.get(f"/v1/tunings/tuning-1{part}"), 507, "storage-error")
            assert "/export" in told["remedy"]
        listed = (await service.client.get("/v1/tunings")).json()["tunings"]
        assert {row["id"] for row in listed} == {"tuning-1", "tuning-2"}
        assert (await service.client.get("/v1/tunings/tuning-2/export")).status_code == 200
