"""The simulated driver, in virtual time."""

import asyncio
import math

import pytest

from autotuner.errors import ConfigurationError, DeviceRefusedError, InputError, LinkError
from autotuner.ports import Backend
from autotuner_drivers.simulated import create

PLANT = {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5}
REST = {"plant": PLANT, "output0": 40.0, "pv0": 80.0}


def test_it_is_a_backend_with_a_controller_of_its_own():
    backend = create(REST)
    assert isinstance(backend, Backend)
    assert backend.readable == {"pv", "output", "set_point", "auto", "kp", "ti", "td"}
    assert backend.writable == backend.readable - {"pv"}


def test_the_pv_follows_the_step_response_on_the_clock_of_the_loop(virtual):
    async def main():
        backend = create(REST)
        await backend.open()
        await asyncio.sleep(100.0)
        at_rest = await backend.read(["pv", "output", "auto", "set_point"])
        await backend.write({"output": 45.0})
        await asyncio.sleep(11.5)
        moved = await backend.read(["pv"])
        await backend.close()
        return at_rest, moved

    at_rest, moved = virtual(main())
    assert at_rest == {"pv": 80.0, "output": 40.0, "auto": 0.0, "set_point": 80.0}
    assert moved["pv"] == pytest.approx(80.0 + 10.0 * (1.0 - math.exp(-1.0)), rel=1e-9)


def test_noise_is_seeded_and_each_reading_is_new(virtual):
    async def readings(seed):
        backend = create(REST | {"noise": 0.5, "seed": seed})
        await backend.open()
        return [(await backend.read(["pv"]))["pv"] for _ in range(200)]

    first, again, other = (virtual(readings(seed)) for seed in (1, 1, 2))
    assert first == again != other
    assert len(set(first)) == 200
    mean = sum(first) / 200
    assert mean == pytest.approx(80.0, abs=0.15)
    assert math.sqrt(sum((x - mean) ** 2 for x in first) / 199) == pytest.approx(0.5, rel=0.2)


def test_resolution_of_the_reading(virtual):
    async def main():
        backend = create(REST | {"noise": 0.5, "quantisation": 0.25})
        await backend.open()
        return [(await backend.read(["pv"]))["pv"] for _ in range(50)]

    assert all(pv % 0.25 == 0.0 for pv in virtual(main()))


def test_auto_is_taken_and_given_back(virtual):
    async def main():
        backend = create(REST | {"auto": True, "set_point": 90.0, "gains": {"kp": 2.0, "ti": 10.0}})
        await backend.open()
        await asyncio.sleep(300.0)
        settled = await backend.read(["pv", "output", "auto"])
        await backend.write({"output": 10.0})
        ignored = await backend.read(["output"])
        await backend.write({"auto": 0.0, "output": 50.0})
        taken = await backend.read(["output", "auto"])
        await asyncio.sleep(5.0)
        await backend.write({"auto": 1.0})
        await asyncio.sleep(300.0)
        return settled, ignored, taken, await backend.read(["pv", "auto"])

    settled, ignored, taken, returned = virtual(main())
    assert settled == {"pv": pytest.approx(90.0), "output": pytest.approx(45.0), "auto": 1.0}
    assert ignored == {"output": pytest.approx(45.0)}
    assert taken == {"output": 50.0, "auto": 0.0}
    assert returned == {"pv": pytest.approx(90.0), "auto": 1.0}


def test_gains_are_registers_like_any_other(virtual):
    async def main():
        backend = create(REST)
        await backend.open()
        await backend.write({"kp": 2.5, "ti": 12.0, "td": 0.5, "set_point": 81.0})
        return await backend.read(["kp", "ti", "td", "set_point"])

    assert virtual(main()) == {"kp": 2.5, "ti": 12.0, "td": 0.5, "set_point": 81.0}


def test_effects_are_hidden_in_the_plant(virtual):
    async def main():
        backend = create(
            REST | {"effects": [{"effect": "backlash", "width": 4.0}, {"effect": "drift", "rate_per_s": 0.01}]}
        )
        await backend.open()
        await backend.write({"output": 45.0})
        await asyncio.sleep(200.0)
        return (await backend.read(["pv"]))["pv"]

    # half of the play is lost: 2 * (5 - 2); the drift adds 2
    assert virtual(main()) == pytest.approx(80.0 + 6.0 + 2.0, abs=1e-6)


def test_a_lag_chain_takes_a_list(virtual):
    async def main():
        backend = create({"plant": {"structure": "lag_chain", "K": 1.0, "lags": [1, 1, 1], "D": 0.0}})
        await backend.open()
        await backend.write({"output": 1.0})
        await asyncio.sleep(3.0)
        return (await backend.read(["pv"]))["pv"]

    # three equal lags: 1 - e^-3 (1 + 3 + 9/2)
    assert virtual(main()) == pytest.approx(1.0 - math.exp(-3.0) * 8.5)


def test_it_runs_on_while_closed_and_opens_again(virtual):
    async def main():
        backend = create(REST)
        with pytest.raises(LinkError, match="not open"):
            await backend.read(["pv"])
        await backend.open()
        await backend.open()
        await backend.write({"output": 45.0})
        await backend.close()
        await backend.close()
        with pytest.raises(LinkError, match="not open"):
            await backend.write({"output": 0.0})
        await asyncio.sleep(11.5)
        await backend.open()
        return (await backend.read(["pv"]))["pv"]

    assert virtual(main()) == pytest.approx(80.0 + 10.0 * (1.0 - math.exp(-1.0)))


def test_what_is_no_number_or_no_signal_is_refused_before_anything_moves(virtual):
    async def main():
        backend = create(REST)
        await backend.open()
        with pytest.raises(DeviceRefusedError, match="output: is not a finite number"):
            await backend.write({"kp": 9.0, "output": math.nan})
        with pytest.raises(InputError, match="signal"):
            await backend.write({"kp": 9.0, "pv": 1.0})
        with pytest.raises(InputError, match="signal"):
            await backend.read(["temperature"])
        return await backend.read(["output", "kp"])

    assert virtual(main()) == {"output": 40.0, "kp": 1.0}


@pytest.mark.parametrize(
    ("changes", "key", "value"),
    [
        ({"plant": None}, "plant", None),
        ({"plant": {"structure": "fopdt", "K": 2.0, "T": 10.0}}, "plant.D", None),
        ({"plant": PLANT | {"K": "2"}}, "plant.K", "2"),
        ({"plant": PLANT | {"K": True}}, "plant.K", True),
        ({"plant": PLANT | {"Z": 2.0}}, "plant.Z", 2.0),
        ({"plant": PLANT | {"structure": "third_order"}}, "plant.structure", "third_order"),
        ({"plant": PLANT | {"T": -1.0}}, "plant", None),
        ({"plant": PLANT | {"K": 0.0}}, "plant", None),
        ({"plant": {"structure": "lag_chain", "K": 1.0, "lags": [], "D": 0.0}}, "plant", None),
        ({"noise": -0.1}, "noise", -0.1),
        ({"noise": math.nan}, "noise", None),
        ({"seed": 1.5}, "seed", 1.5),
        ({"output0": 200.0}, "plant", None),
        ({"output_limits": [5.0, 5.0]}, "output_limits", [5.0, 5.0]),
        ({"output_limits": 5.0}, "output_limits", 5.0),
        ({"effects": [{"effect": "rust"}]}, "effects[0].effect", "rust"),
        ({"effects": [{"effect": "backlash", "width": 1.0, "depth": 1.0}]}, "effects[0].depth", 1.0),
        ({"effects": "backlash"}, "effects", "backlash"),
        ({"gains": {"ti": -1.0}}, "gains.ti", -1.0),
        ({"gains": {"ki": 1.0}}, "gains.ki", 1.0),
        ({"scan_s": 0.0}, "scan_s", 0.0),
        ({"nois": 1.0}, "nois", 1.0),
    ],
)
def test_options_that_cannot_work_are_refused_by_key_value_and_remedy(changes, key, value):
    options = {name: option for name, option in (REST | changes).items() if option is not None}
    with pytest.raises(ConfigurationError) as refusal:
        create(options)
    assert refusal.value.field == key
    assert refusal.value.remedy
    if value is not None:
        assert refusal.value.value == value


def test_a_misspelt_key_is_told_its_neighbour():
    with pytest.raises(ConfigurationError, match="Did you mean noise"):
        create(REST | {"nois": 1.0})
