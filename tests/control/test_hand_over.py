"""Take-over and release that the process does not feel, on devices whose registers do not follow their controller."""

import asyncio

import pytest

from autotuner.control.clock.ticker import Ticker
from autotuner.control.driving.release_watch import bump_at_release, noise_of
from autotuner.errors import DeviceRefusedError, LinkError
from autotuner.ports import AUTO, MANUAL_OUTPUT, OUTPUT, PV, SET_POINT
from tests.control.conftest import Rig

pytestmark = pytest.mark.usefixtures("without_diagnosis")

GAINS = {"kp": 1.0, "ti": 20.0, "td": 0.0}


class ManualRegister:
    """A device whose manual output is a register of its own: in auto it keeps what it holds.

    `takes` says what becomes of a write in auto: it is taken, ignored, or refused.
    """

    def __init__(self, inner, manual, takes):
        self.inner, self.manual, self.takes, self.written = inner, manual, takes, []
        self.readable, self.writable = inner.readable | {MANUAL_OUTPUT}, inner.writable
        self.open, self.close = inner.open, inner.close

    async def read(self, names):
        seen = await self.inner.read([name for name in names if name != MANUAL_OUTPUT])
        return seen | ({MANUAL_OUTPUT: self.manual} if MANUAL_OUTPUT in names else {})

    async def write(self, values):
        self.written.append(dict(values))
        auto = (await self.inner.read([AUTO]))[AUTO]
        if OUTPUT in values and auto:
            if self.takes == "refused":
                raise DeviceRefusedError("the register is locked in auto", remedy="Go to manual first.")
            self.manual = values[OUTPUT] if self.takes == "taken" else self.manual
            return
        if OUTPUT in values:
            self.manual = values[OUTPUT]
        await self.inner.write(values)
        if values.get(AUTO) == 0.0:
            await self.inner.write({OUTPUT: self.manual})


def rig_with(manual, takes, **keys):
    rig = Rig(device={"auto": True, "gains": GAINS}, relay={"amplitude": 10.0, "check": False}, **keys)
    rig.backend = ManualRegister(rig.device, manual, takes)
    return rig


def conducted(virtual, rig):
    async def main():
        one = rig()
        verdict = await one.conduct()
        return one, verdict, await one.now(OUTPUT, AUTO, SET_POINT)

    return virtual(main())


@pytest.mark.one_of(2)
@pytest.mark.parametrize("manual", [0.0, 40.0], ids=["elsewhere", "where it is"])
def test_a_manual_register_is_preloaded_before_the_mode_is_changed(virtual, manual):
    one, verdict, after = conducted(virtual, lambda: rig_with(manual, "taken"))
    assert verdict.outcome == "done"
    names = [next(iter(values)) for values in one.backend.written]
    assert names.index(AUTO) == (1 if manual == 0.0 else 0)
    before_the_relay = [sample.output for sample in one.tuning.samples[:20]]
    assert max(before_the_relay) - min(before_the_relay) < 0.5
    assert after[AUTO] == 1.0


@pytest.mark.parametrize(("takes", "words"), [("ignored", "ignores writes"), ("refused", "locked in auto")])
def test_a_jump_that_cannot_be_prevented_is_refused_with_its_size(virtual, takes, words):
    one, verdict, after = conducted(virtual, lambda: rig_with(15.0, takes))
    assert (verdict.code, verdict.outcome) == ("manual_output_differs", "refused")
    jump = float(verdict.message.partition("jump by ")[2].split(",")[0])
    assert jump == pytest.approx(-25.0, abs=0.5)
    assert words in verdict.message
    assert after[AUTO] == 1.0
    assert all(values.get(AUTO) != 0.0 for values in one.backend.written)
    assert one.tuning.controller.restored


def test_readings_before_take_over_reach_the_viewers(virtual):
    one, _, _ = conducted(virtual, lambda: rig_with(40.0, "taken"))
    kinds = [event.type for event in one.tuning.events]
    observed = [event for event in one.tuning.events if event.type == "observed"]
    assert len(observed) == 25
    assert kinds.index("observed") < kinds.index("sample")
    assert all(abs(event.pv - 80.0) < 1.0 for event in observed)


class Bumping(ManualRegister):
    """A controller that starts from an integral of its own when it goes back to auto."""

    async def read(self, names):
        seen = await super().read(names)
        released = any(values.get(AUTO) == 1.0 for values in self.written)
        return seen | ({OUTPUT: seen[OUTPUT] + 12.0} if released and OUTPUT in names else {})


def test_a_bump_at_release_is_told_in_events_result_and_log(virtual, caplog):
    caplog.set_level("INFO")

    def make():
        rig = rig_with(40.0, "taken")
        rig.backend = Bumping(rig.device, 40.0, "taken")
        return rig

    one, verdict, _ = conducted(virtual, make)
    assert verdict.outcome == "done"
    (bump,) = [event for event in one.tuning.events if event.type == "bump"]
    assert bump.output == pytest.approx(12.0, abs=1.5)
    (warning,) = [text for text in one.tuning.to_dict()["warnings"] if "jumped" in text]
    assert warning == str(bump)
    assert str(bump) in caplog.text


def test_a_controller_that_takes_over_smoothly_is_no_bump(virtual):
    one, _, _ = conducted(virtual, lambda: rig_with(40.0, "taken"))
    assert not [event for event in one.tuning.events if event.type == "bump"]


def test_a_link_that_is_lost_after_release_is_no_bump(virtual):
    class Lost:
        readable = frozenset({PV, OUTPUT, AUTO})

        async def read(self, _names):
            raise LinkError("gone", remedy="Look.")

    async def main():
        await asyncio.sleep(0.0)
        return await bump_at_release(Lost(), 40.0, 0.1, Ticker(0.1), 0.5)

    assert virtual(main()) is None


def test_noise_of_an_output():
    """By hand: deviations -1, 0, 1 have the standard deviation 1."""
    assert noise_of([39.0, 40.0, 41.0], 0.5) == pytest.approx(4.5)
    assert noise_of([40.0], 0.5) == 0.5
