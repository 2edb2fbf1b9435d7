"""The way back ends at its limit, whatever a driver still waits for; what can succeed inside it is never given up."""

import asyncio

import async_solipsism
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotuner.control.clock.ticker import Ticker
from autotuner.control.devices.retrying import persistently
from autotuner.core.verdict import aborted
from autotuner.errors import LinkError
from autotuner.ports import OUTPUT
from tests.control.conftest import Rig

REST = 40.0
STOP = aborted("requested", "stopped", "Start it again.")


def trying(limit_s, took_s, answers_from_s=float("inf")):
    """Try with attempts that take so long; return what came of it, when it ended, and when each attempt began."""
    begun = []

    async def main():
        now_s, ticker = asyncio.get_running_loop().time, Ticker(0.1)

        async def attempt():
            begun.append(now_s())
            await asyncio.sleep(took_s)
            if begun[-1] < answers_from_s:
                raise LinkError("the line is dead", remedy="Plug it in.")
            return "done"

        return await persistently(attempt, ticker, lambda _: None, limit_s), now_s()

    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:  # an example of hypothesis has no fixtures
        return *runner.run(main()), begun


@pytest.mark.parametrize("took_s", [0.0, 0.3, 7.0, 50.0, 1000.0])
def test_it_ends_at_its_limit(took_s):
    """Three readings on a dead serial line take twelve seconds: the last attempt was that much too long."""
    result, ended_s, _ = trying(20.0, took_s)
    assert result is None
    assert ended_s == pytest.approx(20.0, abs=2e-3)


@given(
    limit_s=st.integers(1, 700),
    took_s=st.integers(0, 60000).map(lambda ms: ms / 1000.0),
    share=st.integers(0, 120).map(lambda percent: percent / 100.0),
)
def test_what_can_succeed_inside_the_limit_is_not_given_up(limit_s, took_s, share):
    """Whatever an attempt takes, and whenever the device answers again."""
    result, ended_s, begun = trying(limit_s, took_s, share * limit_s)
    good = [at for at in begun if at >= share * limit_s and at + took_s < limit_s - 1e-3]
    assert (result == "done") or not good
    assert ended_s <= limit_s + 2e-3
    if result == "done":
        assert ended_s == pytest.approx(begun[-1] + took_s, abs=1e-4)


def test_the_last_attempts_come_shortly_before_the_limit():
    """A device that answers again in the last second has its loop back."""
    result, ended_s, _ = trying(20.0, 0.05, 19.5)
    assert result == "done"
    assert 19.5 <= ended_s <= 20.0


def ended(virtual, script=None, **keys):
    """Abort a tuning in its relay, from where on the device does what a script says; tell how long it took."""

    async def main():
        one = Rig(**keys)
        work = asyncio.create_task(one.conduct())
        await one.moved()
        if script is not None:
            one.backend.script = script
        asked_s = asyncio.get_running_loop().time()
        one.tuning.abort(STOP)
        verdict = await work
        return one, verdict, asyncio.get_running_loop().time() - asked_s, (await one.now(OUTPUT))[OUTPUT]

    return virtual(main())


def test_a_device_that_hangs_is_given_up_at_the_limit_and_said_to_be_unknown(virtual):
    async def hanging(call, _number, _names):
        if call in {"open", "write"}:
            await asyncio.sleep(1e6)

    one, verdict, took_s, _ = ended(virtual, hanging, restore_limit_s=25.0)
    assert verdict.code == "output_unknown"
    assert took_s == pytest.approx(25.0, abs=0.2)  # a sample under way is awaited before
    told = [event.message for event in one.tuning.events if event.type == "output_unknown"]
    assert told[0].startswith("was given up: its time was over")
    assert told[-1].startswith("25 s are over: it is left as it is; ")


def test_a_slow_way_that_the_device_follows_goes_to_its_end(virtual):
    """Five of output at two a second, with a limit of one second for a device that does not answer."""
    limits = {"output": [0.0, 100.0], "pv": [0.0, 250.0], "output_slew_per_s": 2.0}
    one, verdict, took_s, output = ended(virtual, limits=limits, restore_limit_s=1.0)
    assert (verdict, output) == (STOP, REST)
    assert took_s > 2.0
    assert one.tuning.controller.restored


def test_a_slow_way_on_which_the_device_dies_ends(virtual):
    limits = {"output": [0.0, 100.0], "pv": [0.0, 250.0], "output_slew_per_s": 2.0}

    async def dying(call, number, _names):
        dying.first = dying.first or number if call == "write" else dying.first
        if call == "write" and number > dying.first + 15:  # one and a half seconds later
            raise LinkError("the line is dead", remedy="Plug it in.")

    dying.first = None
    _, verdict, took_s, output = ended(virtual, dying, limits=limits, restore_limit_s=1.0)
    assert verdict.code == "output_unknown"
    assert 1.5 <= took_s < 2.0
    assert output != REST
