"""What is said of a line that is slow, silent now and then, or damages what it carries."""

import pytest

from autotuner.core.line_quality import line_warnings
from autotuner.core.recording import Sample


def record(times_s):
    return [Sample(t, 20.0, 50.0) for t in times_s]


EVERY_TENTH = [k / 10.0 for k in range(400)]
GAP = [t for t in EVERY_TENTH if not 10.0 < t < 11.5]
CASES = {
    "as asked": (EVERY_TENTH, 2, ()),
    "slow": ([0.41 * k for k in range(100)], 0, ("every 0.41 s, not every 0.1 s", "sample_time_s to 0.49")),
    "one sample is missing": ([t for t in EVERY_TENTH if t != 10.0], 0, ()),
    "silent for a while": (GAP, 0, ("14 of 400 samples are missing, for 1.5 s at the longest",)),
    "asked again": (EVERY_TENTH, 3, ("3 requests in 400 samples", "timeout_s")),
    "too short to tell": ([0.0, 0.9, 1.8], 3, ()),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_said_of_a_line(case):
    times_s, repeated, words = CASES[case]
    told = line_warnings(record(times_s), 0.1, repeated)
    assert len(told) == bool(words)
    assert all(word in told[0] for word in words)
