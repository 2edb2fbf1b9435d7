"""What is forgotten, by a number and by a size."""

from hypothesis import given
from hypothesis import strategies as st

from autotuner.service.archive.retention import Retention

SIZES = [("e", 10), ("d", 10), ("c", 10), ("b", 10), ("a", 10)]


def test_the_oldest_go_first():
    assert Retention(3, 1000).surplus(SIZES, ()) == ["b", "a"]
    assert Retention(100, 35).surplus(SIZES, ()) == ["b", "a"]
    assert Retention(100, 1000).surplus(SIZES, ()) == []


def test_what_runs_stays():
    assert Retention(1, 1000).surplus(SIZES, {"a", "c"}) == ["d", "b"]


def test_the_newest_stays_however_large():
    assert Retention(5, 5).surplus(SIZES, ()) == ["d", "c", "b", "a"]


@given(st.lists(st.integers(0, 100), max_size=20), st.integers(1, 10), st.integers(0, 500), st.sets(st.integers(0, 20)))
def test_what_stays_fits(sizes, tunings, size_bytes, running):
    rows = [(str(k), size) for k, size in enumerate(sizes)]
    gone = Retention(tunings, size_bytes).surplus(rows, {str(k) for k in running})
    assert not set(gone) & {str(k) for k in running}
    stays = [(key, size) for key, size in rows if key not in gone and int(key) not in running]
    assert len(stays) <= tunings
    assert sum(size for _, size in stays) <= size_bytes or [key for key, _ in stays] == ["0"]
