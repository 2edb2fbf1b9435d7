"""What a service manager hears: words on a real socket, in virtual time."""

import asyncio
import contextlib
import socket

import pytest

from autotuner.service.operations.sd_notify import Attendance, ServiceManager

MORE_TIME = "EXTEND_TIMEOUT_USEC=10000000"


@pytest.fixture
def manager(tmp_path):
    """A service manager's socket, and a function that returns what it has heard since."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(str(tmp_path / "notify"))
        line.setblocking(False)

        def heard():
            words = []
            with contextlib.suppress(BlockingIOError):
                while True:
                    words.append(line.recv(100).decode())
            return words

        yield str(tmp_path / "notify"), heard


@pytest.mark.virtual_time
async def test_a_service_asks_for_time_until_it_is_ready_lives_and_stops(manager):
    address, heard = manager
    attendance = Attendance(ServiceManager(address, 0.5))
    attendance.starts()
    await asyncio.sleep(1.2)
    assert heard() == [MORE_TIME] * 3
    attendance.is_ready()
    await asyncio.sleep(1.2)
    assert heard() == ["READY=1"] + ["WATCHDOG=1"] * 3
    attendance.stops()
    await asyncio.sleep(1.2)
    assert heard() == ["STOPPING=1"] + [MORE_TIME] * 3
    await attendance.end()
    await asyncio.sleep(5.0)
    assert heard() == []


@pytest.mark.virtual_time
async def test_a_service_manager_that_does_not_listen_keeps_nothing_from_being_done(tmp_path):
    for address in (str(tmp_path / "nobody"), None):
        attendance = Attendance(ServiceManager(address))
        attendance.starts()
        attendance.is_ready()
        await asyncio.sleep(10.0)
        attendance.stops()
        await attendance.end()


@pytest.mark.parametrize(
    ("variables", "manager"),
    [
        ({}, ServiceManager(None, 2.0)),
        ({"NOTIFY_SOCKET": "/run/notify"}, ServiceManager("/run/notify", 2.0)),
        ({"NOTIFY_SOCKET": "@notify", "WATCHDOG_USEC": "4000000"}, ServiceManager("\0notify", 1.0)),
        ({"NOTIFY_SOCKET": "/n", "WATCHDOG_USEC": "4000000", "WATCHDOG_PID": "7"}, ServiceManager("/n", 1.0)),
        ({"NOTIFY_SOCKET": "/n", "WATCHDOG_USEC": "4000000", "WATCHDOG_PID": "8"}, ServiceManager("/n", 2.0)),
        ({"NOTIFY_SOCKET": "/n", "WATCHDOG_USEC": "60000000"}, ServiceManager("/n", 2.0)),
        ({"NOTIFY_SOCKET": "/n", "WATCHDOG_USEC": "soon"}, ServiceManager("/n", 2.0)),
    ],
)
def test_it_is_what_the_environment_says_and_no_process_of_ours_inherits_it(variables, manager):
    environment = {"HOME": "/root", **variables}
    assert ServiceManager.of(environment, 7) == manager
    assert environment == {"HOME": "/root"}
