"""The durable store is opened, read and closed by several threads and by several programs."""

import subprocess
import sys
import threading

from autotuner.control.records.store import CHANGES, Store, row


def test_an_opening_during_the_last_closing_gets_a_store_that_writes(tmp_path):
    store = Store(tmp_path)
    store.open()
    writing, go_on = threading.Event(), threading.Event()

    def hold_the_writer():
        writing.set()
        go_on.wait()

    store._thread.submit(hold_the_writer)
    assert writing.wait(10.0)
    closing, opening = threading.Thread(target=store.close), threading.Thread(target=store.open)
    closing.start()
    while store._users:
        pass
    opening.start()
    opening.join(0.1)  # it ends here when it does not wait for the closing
    go_on.set()
    closing.join()
    opening.join()
    store.submit([row(CHANGES, "TIC-101", 0, {"Kp": 2.0})]).result()
    store.close()
    assert Store(tmp_path).rows(CHANGES, "TIC-101").values == [{"Kp": 2.0}]


ANOTHER_PROGRAM = """
import sys
from pathlib import Path
from autotuner.control.records.store import CHANGES, Store
store = Store(Path(sys.argv[1]))
store.open()
store.close()
print(len(store.rows(CHANGES, "TIC-101").values))
"""


def rows_seen_by_another_program(folder):
    done = subprocess.run([sys.executable, "-c", ANOTHER_PROGRAM, folder], check=True, capture_output=True, text=True)
    return int(done.stdout)


def test_another_program_that_comes_and_goes_takes_no_log_away(tmp_path):
    """A reader in the same process must not end the locks of the writer: its log would be deleted under it."""
    store = Store(tmp_path, in_place=True)
    store.open()
    for place in range(2):
        store.submit([row(CHANGES, "TIC-101", place, {"Kp": 2.0})]).result()
        assert len(Store(tmp_path).rows(CHANGES, "TIC-101").values) == place + 1
        assert rows_seen_by_another_program(tmp_path) == place + 1
    store.close()
