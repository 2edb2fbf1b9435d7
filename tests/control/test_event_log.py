"""The log says how each tuning went and where its output ended."""

import logging

from autotuner.control.reporting.event_log import EventLog
from autotuner.control.reporting.events import OutputRestored, OutputUnknown
from autotuner.errors import LinkError


def test_the_log_tells_phases_and_where_the_output_ended(rig, virtual, caplog):
    caplog.set_level(logging.INFO, logger="autotuner.control.reporting.event_log")

    async def main():
        return await rig().conduct()

    virtual(main())
    lines = [record.getMessage() for record in caplog.records]
    assert "tuning T1 of loop TIC-101" in lines[0]
    assert any(line.endswith("output back at 40, read back") for line in lines)
    assert "done (identified)" in lines[-1]
    assert len(lines) < 20


def test_a_dead_link_is_a_warning(rig, virtual, caplog):
    async def dead_after_the_first_writes(call, number, _names):
        if call == "write" and number >= 2:
            raise LinkError("the line is dead", remedy="Plug it in.")

    async def main():
        return await rig(dead_after_the_first_writes, restore_limit_s=5.0).conduct()

    virtual(main())
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert any("output unknown after attempt 1" in line for line in warnings)


def test_an_unknown_output_is_followed_by_its_all_clear_at_the_same_level(caplog):
    """A log that shows warnings only must not end with an alarm that is over."""
    caplog.set_level("WARNING")
    log = EventLog()
    for event in (
        OutputUnknown(1.0, 1, "no answer"),
        OutputUnknown(2.0, 2, "no answer"),
        OutputRestored(3.0, 40.0, verified=True),
        OutputRestored(4.0, 40.0, verified=True),
    ):
        log.take("T1", "TIC", event)
    texts = [record.getMessage() for record in caplog.records]
    assert [text.partition(": ")[2] for text in texts] == [
        "output unknown after attempt 1: no answer",
        "output unknown after attempt 2: no answer",
        "all clear: output back at 40, read back",
    ]
