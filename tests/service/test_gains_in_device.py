"""Gains of a tuning into the device over HTTP, and back: on simulated devices with their own controller."""

import asyncio
import json
import logging

import pytest

from autotuner.application.computing.compute_pool import InPlace
from autotuner.errors import DeviceRefusedError, LinkError
from autotuner.ports import SET_POINT
from autotuner.service.schemas.resources import VerificationResult
from tests.service.conftest import HEATER

pytestmark = [pytest.mark.virtual_time, pytest.mark.usefixtures("without_diagnosis")]

OLD = {"kp": 1.0, "ti": 20.0, "td": 0.0}
QUICK = {"check": False, "structure": "fopdt"}
GAINS = {"form": "ideal", "derivative_filter": 8.0}


@pytest.fixture
def loops():
    """Return a function that makes one loop `heater` with gains, changed as said."""

    def make(**changes):
        device = HEATER["device"] | changes.pop("device", {})
        made = HEATER | {"gains": GAINS, "device": device} | changes
        return {"heater": {name: value for name, value in made.items() if value is not None}}

    return make


async def tuned(client, **body):
    """Tune to the end; return what is told of it."""
    started = (await client.post("/v1/loops/heater/tunings", json=QUICK | body)).json()
    await client.get(started["links"]["events"])
    return (await client.get(started["links"]["self"])).json()


async def test_apply_and_roll_back(serving, configure, loops, undescribed):
    async with serving(configure(loops())) as service:
        client = service.client
        before = (await client.get("/v1/loops/heater/gains")).json()
        assert (before["values"], before["undo"]) == (OLD, None)
        tuning = await tuned(client)
        assert (tuning["device_gains"], tuning["applied"]) == (OLD, None)
        answer = await client.post(tuning["links"]["apply"])
        applied = answer.json()
        assert answer.status_code == 200
        assert applied["old"]["values"] == OLD
        wanted = tuning["gains"]
        assert applied["now"]["values"] == {"kp": wanted["Kp"], "ti": wanted["Ti"], "td": wanted["Td"]}
        assert applied["margins"]["Ms"] < 1.5
        now = (await client.get("/v1/loops/heater/gains")).json()
        assert now["values"] == applied["now"]["values"]
        assert now["undo"]["old"] == OLD
        told = (await client.get(tuning["links"]["self"])).json()
        assert told["applied"] == applied
        back = (await client.post(tuning["links"]["rollback"])).json()
        assert back["now"]["values"] == OLD
        assert (await client.get("/v1/loops/heater/gains")).json()["values"] == OLD


async def test_other_gains_of_the_same_model(serving, configure, loops):
    async with serving(configure(loops())) as service:
        tuning = await tuned(service.client)
        applied = (await service.client.post(tuning["links"]["apply"], json={"rule": "amigo_pi"})).json()
        assert applied["now"]["gains"]["controller"] == "PI"
        assert applied["now"]["values"]["td"] == 0.0


async def test_a_loop_without_gains_says_what_to_do(serving, configure, loops, check_problem):
    async with serving(configure(loops(gains=None))) as service:
        tuning = await tuned(service.client)
        for path in (tuning["links"]["apply"], tuning["links"]["rollback"]):
            problem = check_problem(await service.client.post(path), 422, "unusable-value")
            assert problem["field"] == "loops.heater.gains"
        started = await service.client.post("/v1/loops/heater/tunings", json={"apply": True})
        check_problem(started, 422, "unusable-value")


async def test_gains_that_somebody_else_has_set_are_left_alone(serving, configure, loops, check_problem):
    async with serving(configure(loops())) as service:
        tuning = await tuned(service.client)
        backend = service.manager._backends["heater"]
        await backend.open()
        await backend.write({"kp": 1.25})
        problem = check_problem(await service.client.post(tuning["links"]["apply"]), 409, "gains-changed")
        assert (problem["field"], problem["value"]) == ("kp", "1.25")
        await backend.open()
        await backend.write({"kp": 1.0})
        assert (await service.client.post(tuning["links"]["apply"])).status_code == 200
        await backend.open()
        await backend.write({"ti": 33.0})
        check_problem(await service.client.post(tuning["links"]["rollback"]), 409, "gains-changed")
        forced = (await service.client.post(tuning["links"]["rollback"], json={"force": True})).json()
        assert (forced["was"]["values"]["ti"], forced["now"]["values"]) == (33.0, OLD)


async def test_nothing_to_roll_back(serving, configure, loops, check_problem):
    async with serving(configure(loops())) as service:
        tuning = await tuned(service.client)
        check_problem(await service.client.post(tuning["links"]["rollback"]), 409, "wrong-state")
        check_problem(await service.client.post(tuning["links"]["verify"]), 409, "wrong-state")


async def test_never_while_a_tuning_runs(serving, configure, loops, check_problem):
    async with serving(configure(loops())) as service:
        tuning = await tuned(service.client)
        running = (await service.client.post("/v1/loops/heater/tunings")).json()
        problem = check_problem(await service.client.post(tuning["links"]["apply"]), 409, "loop-busy")
        assert problem["tuning_id"] == running["id"]
        check_problem(await service.client.post(running["links"]["apply"]), 409, "wrong-state")


@pytest.mark.parametrize("asked", [True, False], ids=["with the tuning", "later"])
async def test_a_result_is_stored_before_its_gains_are_written(serving, configure, loops, asked):
    """A program that is killed between two registers leaves a result that tells where the gains are from."""
    async with serving(configure(loops())) as service:
        gain_service, real = service.manager.gain_service("heater"), service.manager._backends["heater"]
        seen = []

        class Looking:
            def __getattr__(self, name):
                return getattr(real, name)

            async def write(self, values):
                if "kp" in values:
                    seen.append(await service.app.state.archive.find(service.manager.newest_first()[0].id))
                await real.write(values)

        gain_service.operations.backend = Looking()
        tuning = await tuned(service.client, apply=asked)
        if not asked:
            await service.client.post(tuning["links"]["apply"])
        stored = seen[0].to_dict()
        assert (stored["verdict"]["outcome"], stored["applied"]) == ("done", None)
        assert stored["gains"]["Kp"] == tuning["gains"]["Kp"]


async def test_a_database_that_hangs_keeps_gains_back_for_seconds_and_a_rollback_not_at_all(serving, configure, loops):
    async with serving(configure(loops())) as service:
        tuning = await tuned(service.client)
        service.manager.store = asyncio.Event().wait
        clock = asyncio.get_running_loop()
        begun = clock.time()
        assert (await service.client.post(tuning["links"]["apply"])).status_code == 200
        applied = clock.time()
        assert 5.0 <= applied - begun < 6.0
        back = (await service.client.post(tuning["links"]["rollback"])).json()
        assert back["now"]["values"] == OLD
        assert clock.time() - applied < 1.0


class Clipping:
    """A device between: it clips one gain, or loses the link at a write."""

    def __init__(self, backend, name, *, at=None, fails=None):
        self._backend, self._name, self._at, self._fails = backend, name, at, fails

    def __getattr__(self, name):
        return getattr(self._backend, name)

    async def write(self, values):
        if self._name in values and values[self._name] != OLD[self._name]:
            if self._fails is not None:
                error, self._fails = self._fails, None
                raise error
            values = {**values, self._name: min(values[self._name], self._at)}
        await self._backend.write(values)


@pytest.mark.parametrize(
    ("between", "status", "words"),
    [
        ({"name": "kp", "at": 1.3}, 502, "but the device holds 1.3; the old"),
        ({"name": "td", "fails": DeviceRefusedError("is read-only", remedy="Unlock it.")}, 502, "is read-only"),
        ({"name": "ti", "fails": LinkError("the link was lost", remedy="Look.")}, 502, "the link was lost"),
    ],
    ids=["clipped", "refused", "link lost"],
)
async def test_a_device_that_does_not_take_a_gain_gets_its_old_ones(
    serving, configure, loops, check_problem, between, status, words
):
    async with serving(configure(loops())) as service:
        tuning = await tuned(service.client)
        gain_service, real = service.manager.gain_service("heater"), service.manager._backends["heater"]
        gain_service.operations.backend = Clipping(real, **between)
        problem = check_problem(await service.client.post(tuning["links"]["apply"]), status, "device-error")
        assert words in problem["detail"]
        assert "the old gains are restored (kp 1, ti 20, td 0)" in problem["detail"]
        await real.open()
        assert await real.read(list(OLD)) == OLD
        gain_service._backend = real
        check_problem(await service.client.post(tuning["links"]["rollback"]), 409, "wrong-state")


async def test_a_right_model_passes_its_verification(serving, configure, loops):
    """In manual before and after: set point, output and mode come back, the new gains stay."""
    async with serving(configure(loops())) as service:
        tuning = await tuned(service.client)
        await service.client.post(tuning["links"]["apply"])
        told = (await service.client.post(tuning["links"]["verify"])).json()
        assert (told["passed"], told["rolled_back"], told["verdict"]["code"]) == (True, False, "verified")
        assert told["overshoot"] == pytest.approx(told["predicted_overshoot"], abs=0.05)
        assert await service.device("heater") == (40.0, 0.0)
        backend = service.manager._backends["heater"]
        await backend.open()
        seen = await backend.read([SET_POINT, "kp"])
        assert seen == {SET_POINT: 80.0, "kp": tuning["gains"]["Kp"]}


async def events_of(client, path):
    """Return the events of a stream, as far as it goes."""
    lines = (await client.get(path)).text.splitlines()
    return [json.loads(line.removeprefix("data: ")) for line in lines if line.startswith("data: ")]


async def test_a_verification_is_followed(serving, configure, loops, undescribed, check_problem):
    async with serving(configure(loops())) as service:
        client = service.client
        tuning = await tuned(client)
        path = tuning["links"]["verification_events"]
        check_problem(await client.get(path), 409, "wrong-state")
        await client.post(tuning["links"]["apply"])
        verifying = asyncio.create_task(client.post(tuning["links"]["verify"], json={"step": 4.0}))
        await asyncio.sleep(1.0)
        events = await events_of(client, path)
        result = (await verifying).json()
        phases = [event["phase"] for event in events if event["type"] == "verification_phase"]
        assert phases == ["write", "settle", "rest", "predict", "step", "restore"]
        written = next(event for event in events if event["type"] == "gains_written")
        wanted = {name.lower(): tuning["gains"][name] for name in ("Kp", "Ti", "Td")}
        assert (written["before"], written["written"], written["read_back"]) == (OLD, wanted, wanted)
        step = next(event for event in events if event["type"] == "step_made")
        assert (step["step"], step["set_point"] - step["rest_pv"]) == (4.0, pytest.approx(4.0, abs=0.01))
        after = [event for event in events if event["type"] == "sample" and event["t"] > step["t"]]
        assert after[-1]["pv"] == pytest.approx(step["set_point"], abs=0.5)
        assert after[-1]["t"] - step["t"] == pytest.approx(step["duration_s"], abs=0.5)
        assert all(low < high for _, low, high in step["predicted"])
        assert (events[-1]["type"], events[-1]["passed"], events[-1]["rolled_back"]) == (
            "verification_ended",
            True,
            False,
        )
        assert (result["phase"], result["actor"]) == ("ended", "local")
        assert result["gains"] == {"form": "ideal", **{key: written[key] for key in ("before", "written", "read_back")}}
        assert result["started_at"] <= result["ended_at"]
        assert undescribed(VerificationResult.model_validate(result)) == {}


async def test_a_tuning_applies_and_verifies_by_itself(serving, configure, loops, caplog):
    caplog.set_level(logging.INFO, logger="autotuner.control.reporting.event_log")
    async with serving(configure(loops())) as service:
        tuning = await tuned(service.client, verify=True)
        task = service.manager._tasks.get(tuning["id"])
        if task is not None:
            await task
        told = (await service.client.get(tuning["links"]["self"])).json()
        assert told["verification"]["passed"] is True
        assert told["applied"]["now"]["values"]["kp"] == tuning["gains"]["Kp"]
    told = [record.getMessage() for record in caplog.records if record.name == "autotuner.control.reporting.event_log"]
    about_gains = told[-2:]
    assert "of loop heater: gains written and read back, kp " in about_gains[0]
    assert "of loop heater: verification done (verified): " in about_gains[1]


async def test_a_process_that_changed_since_is_rolled_back(serving, configure, loops, caplog):
    """The gain of the process doubles between tuning and verification: a valve was replaced."""
    caplog.set_level(logging.INFO, logger="autotuner.control.reporting.event_log")
    async with serving(configure(loops())) as service:
        tuning = await tuned(service.client)
        await service.client.post(tuning["links"]["apply"])
        found = service.manager.tuning(tuning["id"]).analysis.identification
        object.__setattr__(found.model, "K", found.model.K / 2.0)
        told = (await service.client.post(tuning["links"]["verify"])).json()
        assert (told["passed"], told["rolled_back"]) == (False, True)
        assert told["verdict"]["code"] == "verification_failed"
        assert "of loop heater: the old gains are restored, kp 1, ti 20, td 0" in caplog.text
        assert (await service.client.get("/v1/loops/heater/gains")).json()["values"] == OLD
        assert await service.device("heater") == (40.0, 0.0)


async def test_an_aborted_verification_gives_everything_back(serving, configure, loops):
    async with serving(configure(loops())) as service:
        tuning = await tuned(service.client)
        await service.client.post(tuning["links"]["apply"])
        verifying = asyncio.create_task(service.client.post(tuning["links"]["verify"]))
        await asyncio.sleep(20.0)
        assert (await service.client.get(tuning["links"]["self"])).json()["verification"]["state"] == "running"
        assert (await service.client.post(tuning["links"]["abort"])).status_code == 202
        told = (await verifying).json()
        assert (told["verdict"]["code"], told["rolled_back"]) == ("requested", True)
        assert await service.device("heater") == (40.0, 0.0)
        assert (await service.client.get("/v1/loops/heater/gains")).json()["values"] == OLD


class TakesLong(InPlace):
    """ComputePool that takes a minute, as many predictions beside each other do on a busy machine."""

    async def run(self, function, /, *args, **kwargs):
        await asyncio.sleep(60.0)
        return await super().run(function, *args, **kwargs)


async def test_a_prediction_that_takes_long_is_no_lost_pv(serving, configure, loops):
    """The loop is watched meanwhile; its PV may be lost for 2 s only."""
    async with serving(configure(loops()), TakesLong()) as service:
        tuning = await tuned(service.client)
        await service.client.post(tuning["links"]["apply"])
        told = (await service.client.post(tuning["links"]["verify"])).json()
        assert (told["passed"], told["verdict"]["code"]) == (True, "verified"), told["verdict"]
