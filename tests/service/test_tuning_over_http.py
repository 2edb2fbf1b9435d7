"""From a request to gains, in virtual time: the real application, runtime and controller on simulated devices."""

import asyncio

import pytest

from autotuner.core.recording import Recording

pytestmark = [pytest.mark.virtual_time, pytest.mark.usefixtures("without_diagnosis")]

LOOP = "/v1/loops/heater/tunings"


async def test_start_follow_and_read_the_result(serving, read_events):
    async with serving() as service:
        started = await service.client.post(LOOP, json={"goal": "calm"})
        assert started.status_code == 202
        assert started.headers["location"] == "/v1/tunings/tuning-1" == started.json()["links"]["self"]
        assert started.json()["state"] == "running"
        assert started.json()["verdict"] is None

        stream = await service.client.get(started.json()["links"]["events"])
        assert stream.headers["content-type"].startswith("text/event-stream")
        assert stream.headers["cache-control"] == "no-cache"
        events = read_events(stream.text)
        result = (await service.client.get("/v1/tunings/tuning-1")).json()

        assert result["state"] == "ended"
        assert result["verdict"]["outcome"] == "done"
        assert result["restored"] is True
        assert await service.device("heater") == (40.0, 0.0)
        truth = {"K": 2.0, "T": 10.0, "D": 1.5}
        assert result["structure"] == "fopdt"
        assert result["model"] == {name: pytest.approx(value, rel=0.05) for name, value in truth.items()}
        assert result["tuning"]["goal"] == "calm"
        assert result["gains"] == result["tuning"]["gains"]

        assert [index for index, _, _ in events] == list(range(len(events)))
        assert all(name == data["type"] for _, name, data in events)
        assert sum(name == "sample" for _, name, _ in events) == result["samples"]
        phases = [data["phase"] for _, name, data in events if name == "phase"]
        assert phases[0] == "arm"
        assert phases[-2:] == ["restore", "ended"]
        estimates = [data for _, name, data in events if name == "estimate"]
        assert [data["half_period"] for data in estimates] == sorted(data["half_period"] for data in estimates)
        assert events[-1][1:] == ("ended", {**events[-1][2], "outcome": "done"})


async def test_a_loop_is_tuned_beside_its_controller(serving):
    """The settings that arrive are those asked for, and the process found is the same as without a controller."""
    async with serving() as service:
        online = {"Kp": 0.5, "Ti": 10.0}
        started = await service.client.post(LOOP, json={"online": online, "rule": "simc_pi"})
        assert started.json()["settings"]["online"].items() >= online.items()
        await service.client.get(started.json()["links"]["events"])
        result = (await service.client.get("/v1/tunings/tuning-1")).json()
        assert result["verdict"]["outcome"] == "done", result["verdict"]
        assert result["model"]["K"] == pytest.approx(2.0, rel=0.05)
        assert await service.device("heater") == (40.0, 0.0)


async def tune_the_furnace(serving):
    """Return everything that an hour of tuning tells."""
    async with serving() as service:
        begun = asyncio.get_running_loop().time()
        await service.client.post("/v1/loops/furnace/tunings", json={"structure": "fopdt", "rule": "simc_pi"})
        events = await service.client.get("/v1/tunings/tuning-1/events")
        result = (await service.client.get("/v1/tunings/tuning-1")).json()
        recording = await service.client.get("/v1/tunings/tuning-1/recording")
        took_s = asyncio.get_running_loop().time() - begun
        found = await service.device("furnace")
    del result["started_at"]
    return took_s, found, result, events.text, recording.text


@pytest.mark.long  # tests/control repeats a run
async def test_more_than_an_hour_of_a_slow_plant_is_the_same_twice(serving):
    first = await tune_the_furnace(serving)
    second = await tune_the_furnace(serving)
    took_s, found, result, events, _ = first
    assert took_s > 3600.0
    assert result["verdict"]["outcome"] == "done"
    assert found == (40.0, 1.0)
    _, first_event, rest = events.partition("data:")  # before it the output in automatic is watched, in silence
    assert first_event
    assert ": ping" not in rest
    assert first == second


async def test_a_quiet_stream_is_kept_alive(serving, configure):
    slow = {"slow": {**configure().loops["heater"].model_dump(exclude_unset=True), "sample_time_s": 40.0}}
    async with serving(configure(slow)) as service:
        await service.client.post("/v1/loops/slow/tunings")
        stream = asyncio.create_task(service.client.get("/v1/tunings/tuning-1/events"))
        await asyncio.sleep(200.0)
        await service.client.post("/v1/tunings/tuning-1/abort")
        text = (await stream).text
    assert text.count(": ping") == 10


async def test_a_busy_loop_names_the_tuning_in_the_way(serving, check_problem):
    async with serving() as service:
        await service.client.post(LOOP)
        problem = check_problem(await service.client.post(LOOP), 409, "loop-busy")
        assert problem["tuning_id"] == "tuning-1"
        assert problem["remedy"] == "Wait until that tuning ends, or abort it."
        other = await service.client.post("/v1/loops/furnace/tunings")
        assert other.status_code == 202
        loops = (await service.client.get("/v1/loops")).json()["loops"]
        assert {loop["name"]: loop["tuning_id"] for loop in loops} == {"heater": "tuning-1", "furnace": "tuning-2"}


async def test_an_abort_in_the_middle_restores(serving, check_problem, read_events):
    async with serving() as service:
        await service.client.post(LOOP)
        stream = asyncio.create_task(service.client.get("/v1/tunings/tuning-1/events"))
        await asyncio.sleep(20.0)
        assert (await service.device("heater"))[0] != 40.0
        asked = await service.client.post("/v1/tunings/tuning-1/abort")
        assert asked.status_code == 202
        events = read_events((await stream).text)
        assert events[-1][2]["outcome"] == "aborted"
        result = (await service.client.get("/v1/tunings/tuning-1")).json()
        assert (result["verdict"]["outcome"], result["verdict"]["code"]) == ("aborted", "requested")
        assert result["restored"] is True
        assert await service.device("heater") == (40.0, 0.0)
        again = await service.client.post("/v1/tunings/tuning-1/abort")
        assert check_problem(again, 409, "wrong-state")["value"] == "'tuning-1'"
        assert (await service.client.post(LOOP)).status_code == 202


async def test_stopping_the_service_restores_every_loop(serving, check_problem):
    async with serving() as service:
        await service.client.post(LOOP)
        await service.client.post("/v1/loops/furnace/tunings")
        await asyncio.sleep(1000.0)
        stream = asyncio.create_task(service.client.get("/v1/tunings/tuning-2/events"))
        assert (await service.client.get("/readyz")).json()["status"] == "ok"
        await asyncio.sleep(0.0)
        closing = asyncio.create_task(service.manager.close())
        await asyncio.sleep(0.0)
        check_problem(await service.client.post("/v1/loops/furnace/tunings"), 503, "shutting-down")
        check_problem(await service.client.get("/readyz"), 503, "shutting-down")
        assert (await service.client.get("/healthz")).status_code == 200
        await closing
        assert "shutdown" in (await stream).text
    assert await service.device("heater") == (40.0, 0.0)
    assert await service.device("furnace") == (40.0, 1.0)
    assert [tuning.verdict.code for tuning in service.manager.tunings.values()][1] == "shutdown"


async def test_a_tuning_that_ran_and_failed_is_no_error(serving, configure):
    heater = configure().loops["heater"].model_dump(exclude_unset=True)
    async with serving(configure({"cooler": {**heater, "process_action": "reverse"}})) as service:
        await service.client.post("/v1/loops/cooler/tunings")
        await service.client.get("/v1/tunings/tuning-1/events")
        response = await service.client.get("/v1/tunings/tuning-1")
        assert response.status_code == 200
        result = response.json()
        assert result["verdict"]["outcome"] == "refused"
        assert result["verdict"]["remedy"]
        assert result["model"] is None
        assert result["gains"] is None
        assert await service.device("cooler") == (40.0, 0.0)


async def test_a_device_that_cannot_be_reached_is_a_verdict(serving, configure, check_problem):
    registers = {"pv": {"table": "input", "address": 0}, "output": {"table": "holding", "address": 0}}
    absent = {"driver": "modbus", "device": {"host": "nowhere", "registers": registers}}
    async with serving(configure({"absent": absent})) as service:
        assert (await service.client.post("/v1/loops/absent/tunings")).status_code == 202
        await service.client.get("/v1/tunings/tuning-1/events")
        result = (await service.client.get("/v1/tunings/tuning-1")).json()
        assert (result["verdict"]["outcome"], result["verdict"]["code"]) == ("failed", "device_unreachable")
        assert (result["samples"], result["before"], result["restored"]) == (0, None, None)
        check_problem(await service.client.get("/v1/tunings/tuning-1/recording"), 409, "wrong-state")
        check_problem(await service.client.post("/v1/tunings/tuning-1/gains"), 409, "wrong-state")


async def test_other_gains_need_no_new_test(serving, check_problem):
    async with serving() as service:
        await service.client.post(LOOP)
        early = await service.client.post("/v1/tunings/tuning-1/gains", json={"goal": "calm"})
        check_problem(early, 409, "wrong-state")
        await service.client.get("/v1/tunings/tuning-1/events")
        first = (await service.client.get("/v1/tunings/tuning-1")).json()
        same = (await service.client.post("/v1/tunings/tuning-1/gains")).json()
        brisk = (await service.client.post("/v1/tunings/tuning-1/gains", json={"goal": "brisk"})).json()
        simc = (await service.client.post("/v1/tunings/tuning-1/gains", json={"rule": "simc_pi"})).json()
        slower = (
            await service.client.post("/v1/tunings/tuning-1/gains", json={"rule": "simc_pi", "tau_c_s": 6.0})
        ).json()
        refused = await service.client.post(
            "/v1/tunings/tuning-1/gains", json={"rule": "cohen_coon_pid", "tau_c_s": 6.0}
        )
    assert same == first["tuning"]
    assert brisk["margins"]["Ms"] > same["margins"]["Ms"]
    assert (simc["goal"], simc["rule"]) == (None, "simc_pi")
    # SIMC: Kp = T / (K (tau_c + D)), tau_c = D unless given, so Kp falls by (6 + D) / (2 D)
    # the sample time is 0.1 s, half of which counts as dead time
    D = first["model"]["D"] + 0.05
    assert simc["gains"]["Kp"] / slower["gains"]["Kp"] == pytest.approx((6.0 + D) / (2.0 * D), rel=1e-9)
    check_problem(refused, 422, "unusable-value")


@pytest.mark.long  # other gains need no new test, above
async def test_a_rule_that_does_not_fit_the_process_does_not_lose_the_test(serving, configure):
    heater = configure().loops["heater"].model_dump(exclude_unset=True)
    plant = {"structure": "sopdt_underdamped", "K": 2.0, "m": 25.0, "n": 4.0, "D": 1.5}
    async with serving(configure({"swing": {**heater, "device": {**heater["device"], "plant": plant}}})) as service:
        await service.client.post("/v1/loops/swing/tunings", json={"rule": "simc_pi"})
        await service.client.get("/v1/tunings/tuning-1/events")
        result = (await service.client.get("/v1/tunings/tuning-1")).json()
        assert result["structure"] == "sopdt_underdamped"
        assert (result["verdict"]["outcome"], result["verdict"]["code"]) == ("refused", "no_gains")
        assert result["gains"] is None
        gains = await service.client.post("/v1/tunings/tuning-1/gains", json={"goal": "calm"})
    assert gains.json()["margins"]["stable"] is True


async def test_lists_are_newest_first_and_by_loop(serving, check_problem):
    async with serving() as service:
        assert (await service.client.get("/v1/tunings")).json() == {"tunings": []}
        for loop in ("heater", "furnace"):
            await service.client.post(f"/v1/loops/{loop}/tunings")
        await service.client.post("/v1/tunings/tuning-1/abort")
        await asyncio.sleep(1.0)
        await service.client.post(LOOP)

        async def listed(query=""):
            tunings = (await service.client.get(f"/v1/tunings{query}")).json()["tunings"]
            return [(tuning["id"], tuning["state"], tuning["code"]) for tuning in tunings]

        everything = [("tuning-3", "running", None), ("tuning-2", "running", None), ("tuning-1", "ended", "requested")]
        assert await listed() == everything
        assert await listed("?loop=heater") == [everything[0], everything[2]]
        assert await listed("?limit=1") == everything[:1]
        check_problem(await service.client.get("/v1/tunings?loop=kiln"), 404, "unknown-loop")


async def test_a_recording_reads_back(serving, check_problem):
    async with serving() as service:
        await service.client.post(LOOP)
        check_problem(await service.client.get("/v1/tunings/tuning-1/recording"), 409, "wrong-state")
        await asyncio.sleep(10.0)
        partial = Recording.from_csv_text((await service.client.get("/v1/tunings/tuning-1/recording")).text)
        await service.client.get("/v1/tunings/tuning-1/events")
        text = await service.client.get("/v1/tunings/tuning-1/recording")
        columns = (await service.client.get("/v1/tunings/tuning-1/recording?format=json")).json()
        ours = service.manager.tuning("tuning-1").recording()
    assert text.headers["content-type"] == "text/csv; charset=utf-8"
    read = Recording.from_csv_text(text.text)
    for name in ("t", "output", "pv", "set_point"):
        assert getattr(read, name).tolist() == getattr(ours, name).tolist()
    assert partial.pv.tolist() == ours.pv[: len(partial)].tolist()
    assert [columns[name] for name in ("t_s", "output", "pv")] == [c.tolist() for c in (ours.t, ours.output, ours.pv)]
    assert columns["settings"]["relay_high"] == ours.settings["relay_high"]


@pytest.mark.parametrize(
    ("query", "accept", "kind"),
    [
        ("", "*/*", "text/csv"),
        ("", "application/json", "application/json"),
        ("", "text/csv;q=0.5, application/json;q=0.6", "application/json"),
        ("", "text/csv, application/json;q=0.6", "text/csv"),
        ("", "application/*, text/csv;q=0.1", "application/json"),
        ("", "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8", "text/csv"),
        ("", "application/json;q=oops", "text/csv"),
        ("?format=csv", "application/json", "text/csv"),
        ("?format=json", "text/csv", "application/json"),
    ],
)
async def test_the_form_of_a_recording_is_negotiated(serving, query, accept, kind):
    async with serving() as service:
        await service.client.post(LOOP)
        await asyncio.sleep(1.0)
        path = f"/v1/tunings/tuning-1/recording{query}"
        answer = await service.client.get(path, headers={"Accept": accept})
    assert answer.headers["content-type"].partition(";")[0] == kind
    assert answer.headers["vary"] == "Accept"


async def test_a_loop_of_any_name_is_found_by_its_links(serving, configure):
    name = "area 1/TIC-101 \u00e4?#%2F"
    loops = {name: configure().loops["heater"].model_dump(exclude_unset=True)}
    async with serving(configure(loops)) as service:
        (loop,) = (await service.client.get("/v1/loops")).json()["loops"]
        assert (await service.client.get(loop["links"]["self"])).json() == loop
        started = await service.client.post(loop["links"]["tunings"])
        assert started.status_code == 202
        assert started.json()["loop"] == name
        assert started.json()["links"]["loop"] == loop["links"]["self"]
