"""The lease of a loop: its table of states, its envelope, the one write and the one restore."""

import ast
import itertools
import math
import re
from pathlib import Path

import pytest

from autotuner.control.clock.ticker import Ticker
from autotuner.control.driving.lease import Goal, Lease, lease_of
from autotuner.control.driving.lease_state import LEASE_STATES, TRANSITIONS, LeaseEvent, LeaseState, next_state
from autotuner.control.records.lease_record import Before, Kind
from autotuner.core.experiment.settings import Limits
from autotuner.core.safety.supervisor import SafetySettings, Supervisor
from autotuner.core.state_table import IllegalTransitionError
from autotuner.core.verdict import aborted
from autotuner.errors import DeviceRefusedError, LinkError, StorageError
from autotuner.ports import AUTO, OUTPUT, SET_POINT

ROOT = Path(__file__).resolve().parents[2]
PATH = ["free", "acquiring", "held", "disturbed", "releasing", "free"]
"""What the issue names: a loop is disturbed only from `held`, and released only by `releasing`."""
CALLED = re.compile(r"(lease|gain_service|self)\.write\(").search
DEAD = LinkError("the line is dead", remedy="Plug it in.")


class Journal:
    """A journal that remembers what was recorded, and may fail to."""

    def __init__(self, device=None, *, fails=False):
        self.entries, self._device, self._fails = [], device, fails

    async def _take(self, *entry):
        if self._fails:
            raise StorageError("cannot be written", remedy="Make room.")
        self.entries.append((*entry, len(self._device.written) if self._device else 0))

    async def disturb(self, before):
        await self._take("found", before.output)

    async def command(self, output):
        await self._take(OUTPUT, output)

    async def set_point(self, value):
        await self._take(SET_POINT, value)

    async def mode(self, auto):
        await self._take(AUTO, auto)

    async def aim(self, target):
        await self._take("target", target)


def leased(one, journal=None, *, safe=None, restore_limit_s=5.0):
    limits = Limits((0.0, 100.0), (0.0, 250.0), safe_output=safe)
    supervisor = Supervisor(limits, SafetySettings(pv_timeout_s=2.0, max_lateness_s=1.0))
    return Lease(one.backend, limits, supervisor, Ticker(0.1), restore_limit_s, journal=journal, scan_s=0.01)


@pytest.mark.parametrize(("state", "event"), list(itertools.product(LeaseState, LeaseEvent)))
def test_an_event_that_the_table_lacks_raises(state, event):
    if (state, event) in TRANSITIONS:
        assert next_state(state, event) is TRANSITIONS[state, event]
    else:
        with pytest.raises(IllegalTransitionError):
            next_state(state, event)


def test_the_table_has_the_states_and_the_path_of_the_design():
    steps = {(before.value, after.value) for (before, _), after in TRANSITIONS.items()}
    assert set(itertools.pairwise(PATH)) <= steps
    assert {("releasing", "unknown"), ("unknown", "releasing")} <= steps
    assert {before for before, after in steps if after == "disturbed"} == {"held", "disturbed"}
    assert {before for before, after in steps if after == "releasing"} == {"disturbed", "unknown"}


def test_the_diagram_in_the_documentation_is_that_of_the_table():
    assert f"```mermaid\n{LEASE_STATES.mermaid()}```" in (ROOT / "docs/safety.md").read_text(encoding="utf-8")


def test_nothing_is_written_before_the_found_values_are_recorded(rig, virtual):
    async def main():
        one = rig()
        lease = leased(one)
        await lease.open()
        lease.envelope[OUTPUT] = (0.0, 100.0)
        with pytest.raises(IllegalTransitionError):
            await lease.write({OUTPUT: 50.0})
        return one.backend.written, lease.state

    assert virtual(main()) == ([], LeaseState.ACQUIRING)


def test_found_values_that_cannot_be_recorded_leave_the_loop_free(rig, virtual):
    async def main():
        one = rig()
        lease = leased(one, Journal(fails=True))
        await lease.open()
        with pytest.raises(StorageError):
            await lease.hold(Before(40.0, 0.0))
        return await lease.release(), one.backend.written, lease.state

    assert virtual(main()) == (True, [], LeaseState.FREE)


def test_each_write_is_recorded_before_it_is_made(rig, virtual):
    async def main():
        one = rig()
        journal = Journal(one.backend)
        lease = leased(one, journal)
        await lease.open()
        await lease.hold(Before(40.0, 0.0))
        for output in (55.0, 25.0):
            await lease.write({OUTPUT: output})
        done = await lease.release()
        return done, journal.entries, one.backend.written, await one.now(OUTPUT)

    done, entries, written, now = virtual(main())
    assert done
    assert entries == [("found", 40.0, 0), (OUTPUT, 55.0, 0), (OUTPUT, 25.0, 1), ("target", 40.0, 2)]
    assert written == [{OUTPUT: 55.0}, {OUTPUT: 25.0}, {OUTPUT: 40.0}]
    assert now == {OUTPUT: 40.0}


def test_an_output_beyond_the_limits_is_cut_and_another_signal_is_refused(rig, virtual):
    async def main():
        one = rig()
        lease = leased(one)
        await lease.open()
        await lease.hold(Before(40.0, 0.0))
        await lease.write({OUTPUT: 140.0})
        with pytest.raises(IllegalTransitionError, match="envelope"):
            await lease.write({AUTO: 2.0})
        with pytest.raises(IllegalTransitionError):
            await lease.write({SET_POINT: 80.0})
        return one.backend.written

    assert virtual(main()) == [{OUTPUT: 100.0}]


def test_a_set_point_outside_its_limits_is_refused(rig, virtual):
    async def main():
        one = rig()
        lease = lease_of(one.loop, one.backend, Kind.VERIFICATION)
        await lease.open()
        await lease.hold(Before(40.0, 1.0, 80.0))
        with pytest.raises(IllegalTransitionError):
            await lease.write({SET_POINT: 251.0})
        return one.backend.written

    assert virtual(main()) == []


def test_gains_are_written_between_old_and_wanted_only(rig, virtual):
    async def main():
        one = rig(device={"gains": {"kp": 1.0, "ti": 20.0, "td": 0.0}})
        lease = lease_of(one.loop, one.backend, Kind.GAINS)
        await lease.open()
        await lease.hold_gains({"kp": 1.0}, {"kp": 3.0})
        await lease.write({"kp": 3.0})
        with pytest.raises(IllegalTransitionError):
            await lease.write({"kp": 3.5})
        return (
            await lease.release_gains({"kp": 1.0}, lambda: one.backend.read(["kp"])),
            await one.now("kp"),
            lease.state,
        )

    assert virtual(main()) == (True, {"kp": 1.0}, LeaseState.FREE)


def test_a_lease_that_was_not_disturbed_is_left_without_a_write(rig, virtual):
    async def main():
        one = rig()
        lease = leased(one)
        await lease.open()
        await lease.hold(Before(40.0, 0.0))
        return await lease.release(), one.backend.written, lease.state

    assert virtual(main()) == (True, [], LeaseState.FREE)


@pytest.mark.parametrize(("end", "output"), [("trip", 5.0), ("abort", 40.0)])
def test_a_limit_ends_at_the_safe_output_and_a_person_at_the_one_found(rig, virtual, end, output):
    async def main():
        one = rig()
        lease = leased(one, safe=5.0)
        await lease.open()
        await lease.hold(Before(40.0, 0.0))
        await lease.write({OUTPUT: 60.0})
        getattr(lease, end)(aborted("x", "ended", "Start again."))
        assert math.isnan(await lease.write({OUTPUT: 61.0}))
        await lease.release()
        return one.backend.written, await one.now(OUTPUT)

    assert virtual(main()) == ([{OUTPUT: 60.0}, {OUTPUT: output}], {OUTPUT: output})


@pytest.mark.parametrize(("operation", "output"), [(Kind.SCHEDULE, None), (Kind.VERIFICATION, 40.0)])
def test_a_limit_on_the_way_to_an_operating_point_leaves_the_output_to_the_controller(rig, virtual, operation, output):
    async def main():
        one = rig(device={"auto": True, "gains": {"kp": 1.0, "ti": 20.0, "td": 0.0}})
        lease = lease_of(one.loop, one.backend, operation)
        await lease.open()
        await lease.hold(Before(40.0, 1.0, 80.0))
        await lease.write({SET_POINT: 90.0})
        lease.trip(aborted("pv_limit", "the PV went to 251", "Check the sensor."))
        goal = await lease.goal()
        return goal.set_point, goal.output, await lease.release(goal), await one.now(SET_POINT, AUTO)

    assert virtual(main()) == (80.0, output, True, {SET_POINT: 80.0, AUTO: 1.0})


def test_a_loop_that_another_one_drives_is_left(rig, virtual):
    async def main():
        one = rig()
        lease = leased(one)
        await lease.open()
        await lease.hold(Before(40.0, 0.0))
        await lease.write({OUTPUT: 60.0})
        lease.trip(aborted("mode_changed", "the device went back to auto", "Start again."))
        return await lease.release(), one.backend.written, lease.state

    assert virtual(main()) == (True, [{OUTPUT: 60.0}], LeaseState.FREE)


def test_over_a_dead_link_the_output_is_unknown_and_restored_once_it_is_back(rig, virtual):
    async def main():
        dead = []

        async def script(call, _number, _names):
            if dead and call in {"open", "read", "write"}:
                raise DEAD

        one = rig(script)
        lease = leased(one)
        await lease.open()
        await lease.hold(Before(40.0, 0.0))
        await lease.write({OUTPUT: 60.0})
        dead.append(True)
        first = await lease.release()
        unknown = lease.state, lease.unknown
        dead.clear()
        return first, unknown, await lease.release(Goal(40.0)), lease.state, await one.now(OUTPUT)

    assert virtual(main()) == (False, (LeaseState.UNKNOWN, OUTPUT), True, LeaseState.FREE, {OUTPUT: 40.0})


def test_gains_that_the_device_keeps_refusing_are_unknown(rig, virtual):
    async def main():
        one = rig(device={"gains": {"kp": 1.0, "ti": 20.0, "td": 0.0}})
        lease = lease_of(one.loop, one.backend, Kind.GAINS, restore_limit_s=1.0)
        await lease.open()
        await lease.hold_gains({"kp": 1.0}, {"kp": 3.0})
        await lease.write({"kp": 3.0})

        async def refuse():
            raise DeviceRefusedError("holds others", remedy="Look at it.")

        return await lease.release_gains({"kp": 1.0}, refuse), lease.state

    assert virtual(main()) == (False, LeaseState.UNKNOWN)


def test_one_place_outside_the_drivers_writes_to_a_device():
    """`Lease._send`; `BackendWithTimeout.write` passes the call on, the others call `Lease.write`."""
    found = set()
    for path in sorted((ROOT / "autotuner").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Await) and ".write(" in (text := ast.unparse(node)) and not CALLED(text):
                found.add((path.relative_to(ROOT).as_posix(), text))
    assert found == {
        ("autotuner/control/driving/lease.py", "await device.write(values)"),
        ("autotuner/control/clock/call_timeout.py", "await self._within_limit(self._backend.write(values))"),
    }
