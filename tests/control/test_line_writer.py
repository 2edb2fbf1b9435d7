"""The lines of the log: gathered, and written whether or not somebody reads them."""

import logging
import os
from queue import SimpleQueue

import pytest

from autotuner.control.reporting.line_writer import GATHERED_S, LineWriter


class Fed(SimpleQueue):
    """Seems to be empty when it is looked at `late` times; then everything is there at once."""

    late = 0

    def empty(self):
        self.late -= 1
        return self.late >= 0 or super().empty()


@pytest.fixture
def pipe():
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


def put(records, count, level=logging.INFO):
    for number in range(count):
        records.put(logging.LogRecord("here", level, "", 0, "line %d: 20 °C", (number,), None))


@pytest.mark.parametrize(("level", "waits"), [(logging.INFO, [GATHERED_S]), (logging.WARNING, [])])
def test_log_lines_gather_but_for_warnings(level, waits, pipe):
    waited, records = [], Fed()
    writer = LineWriter(records, logging.Formatter("%(levelname)s %(message)s"), pipe[1])
    writer._ending.wait = waited.append
    put(records, 20, level)
    records.late = 1
    writer.start()
    writer.stop()
    name = logging.getLevelName(level)
    assert os.read(pipe[0], 4096).decode().splitlines() == [f"{name} line {n}: 20 °C" for n in range(20)]
    assert waited == waits


def test_a_reader_that_is_gone_is_no_error(pipe):
    os.dup2(pipe[1], pipe[0])  # the only reading end is gone
    records = SimpleQueue()
    writer = LineWriter(records, logging.Formatter(), pipe[1])
    put(records, 3)
    writer.start()
    writer.stop()
    assert records.empty()


def test_a_line_that_cannot_be_formatted_holds_no_other_up(pipe):
    records = SimpleQueue()
    records.put(logging.LogRecord("here", logging.INFO, "", 0, "%d samples", ("many",), None))
    put(records, 1)
    writer = LineWriter(records, logging.Formatter(), pipe[1])
    writer.start()
    writer.stop()
    first, second = os.read(pipe[0], 4096).decode().splitlines()
    assert first.startswith("here: '%d samples' cannot be formatted")
    assert second == "line 0: 20 °C"
