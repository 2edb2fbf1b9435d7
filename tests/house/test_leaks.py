"""The suite's own watchman: what a test leaves behind is found, what it gives back is not."""

import subprocess
import sys

import pytest

LEAKING = """
import asyncio, multiprocessing, os, socket, threading
import pytest

KEPT = []
SPAWN = multiprocessing.get_context("spawn")
NEVER = threading.Event()

async def test_task():
    asyncio.create_task(asyncio.sleep(3600), name="forgotten")

@pytest.mark.virtual_time
async def test_virtual_task():
    asyncio.create_task(asyncio.sleep(3600), name="forgotten")

def test_task_in_a_loop_of_its_own(virtual):
    async def main():
        asyncio.create_task(asyncio.sleep(3600), name="forgotten")
    virtual(main())

def test_socket():
    KEPT.append(socket.socket())

def test_terminal():
    KEPT.append(os.openpty())

def test_worker_process():
    reader, writer = SPAWN.Pipe(duplex=False)
    KEPT.append(writer)  # the worker waits until this process is gone
    SPAWN.Process(target=reader.recv, daemon=True).start()

def test_thread():
    threading.Thread(target=NEVER.wait).start()
"""

CLEAN = """
import asyncio, multiprocessing, os, socket, threading
import pytest

@pytest.fixture(scope="module")
def of_the_module():
    with socket.socket() as open_socket:
        yield open_socket

@pytest.fixture
async def server():
    started = await asyncio.start_server(lambda reader, writer: None, "127.0.0.1", 0)
    yield started
    started.close()
    await started.wait_closed()

def test_of_the_module(of_the_module):
    assert of_the_module.fileno() > 0

def test_of_the_module_again(of_the_module):
    assert of_the_module.fileno() > 0

async def test_server(server):
    assert server.sockets

async def test_executor():
    assert await asyncio.to_thread(int, "7") == 7

def test_worker_process_on_its_way_out():
    worker = multiprocessing.get_context("spawn").Process(target=int, daemon=True)
    worker.start()

def test_socket_of_a_thread_on_its_way_out():
    there, end = threading.Event(), threading.Event()
    def hold():
        with socket.socket():
            there.set()
            end.wait()
    threading.Thread(target=hold).start()
    there.wait()
    end.set()

@pytest.mark.virtual_time
async def test_an_hour_is_nothing():
    started = asyncio.get_running_loop().time()
    await asyncio.sleep(3600)
    assert asyncio.get_running_loop().time() == started + 3600
"""


FILES = {"test_leaking.py": LEAKING, "test_clean.py": CLEAN}


@pytest.fixture(scope="module")
def said(tmp_path_factory, pytestconfig):
    """What pytest says of both files under the suite's own conftest and settings; one process, which costs the time."""
    root, folder = pytestconfig.rootpath, tmp_path_factory.mktemp("leaks")
    (folder / "conftest.py").write_text((root / "tests" / "conftest.py").read_text(encoding="utf-8"), encoding="utf-8")
    for name, text in FILES.items():
        (folder / name).write_text(text, encoding="utf-8")
    plugins = ["-p", "no:cacheprovider", "-p", "no:schemathesis"]
    words = ["-c", root / "pyproject.toml", "--rootdir", folder, *plugins, "-q", *FILES]
    return subprocess.run(
        [sys.executable, "-m", "pytest", *words], cwd=folder, capture_output=True, text=True, check=False
    ).stdout


def test_what_is_left_behind_fails(said):
    assert said.count("ERROR test_leaking.py") == 7, said
    assert said.count("left behind: task forgotten") >= 3
    for thing in ("open file socket:", "open file /dev/pt", "thread <Thread", "worker process <SpawnProcess"):
        assert f"left behind: {thing}" in said


def test_what_is_given_back_passes(said):
    assert "14 passed, 7 errors" in said, said
    assert "ERROR test_clean.py" not in said
