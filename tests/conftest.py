"""Shared by all tests: virtual time, leak checks, the reference material.

A test that leaves a task, a thread, a socket, a pseudo-terminal or a worker process behind fails, and so does one after
which the process is another: the level of its log, its environment, its folder, its signals. What was there before its
own fixtures (those of its module or of the session) does not count.
"""

import asyncio
import asyncio.runners
import collections
import contextlib
import functools
import gc
import hashlib
import logging
import multiprocessing
import multiprocessing.connection
import multiprocessing.process
import os
import pickle
import signal
import sys
import tempfile
import threading
from pathlib import Path

import async_solipsism
import hypothesis
import pytest

from autotuner.linear_algebra_threads import use_one_thread

gc.disable()  # until all tests are collected: a quarter of that time is the collector's, and what is made there stays
use_one_thread()  # before anything imports numpy

from autotuner.application.analysis import procedure  # noqa: E402
from autotuner.application.analysis.learned import ARTEFACTS  # noqa: E402
from autotuner.application.computing.compute_pool import InPlace  # noqa: E402
from autotuner.control.devices import plugins  # noqa: E402
from autotuner.core.design import design_procedure  # noqa: E402
from autotuner.errors import InputError  # noqa: E402

hypothesis.settings.register_profile("house", deadline=None)  # how long an example takes depends on the machine
hypothesis.settings.load_profile("house")

SHARED = Path(__file__).parents[1].parent / "shared"
COMPUTED = "AUTOTUNER_TESTS_COMPUTED"
"""Variable of the environment with the folder of what `computed_once` has computed."""
BEFORE, STATUS = pytest.StashKey(), pytest.StashKey()
SIGNALS = sorted(
    signal.valid_signals() & {getattr(signal, name, None) for name in ("SIGTERM", "SIGHUP", "SIGPIPE", "SIGCHLD")}
)
"""Not SIGINT: where it was ignored, as in the background of a script, asyncio leaves Python's own handler."""
THEIRS = ("PYTEST_CURRENT_TEST", "KMP_")
"""How variables of the environment begin that pytest sets, or scikit-learn when it is first imported."""
FROZEN = [False]
"""Whether a test has put objects aside from the collector: to count them takes ten milliseconds."""
OPEN_FILES = "/proc/self/fd"
GRACE_S = 2.0
"""Longest wait for a thread or a worker process that is already on its way out, s."""


@pytest.fixture(scope="session")
def shared():
    """The folder of reference material beside the checkout."""
    if not SHARED.is_dir():
        pytest.skip(f"the reference material is absent: {SHARED}")
    return SHARED


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Leave cases of a test marked `one_of` to the long run, before the selection by marks."""
    cases = collections.Counter()
    for item in items:
        if (marker := item.get_closest_marker("one_of")) is not None:
            case = item.nodeid.partition("[")[0]
            if cases[case] % marker.args[0]:
                item.add_marker(pytest.mark.long)
            cases[case] += 1


@pytest.hookimpl(trylast=True)
def pytest_collection_finish():
    """Let the collector work again, on what the tests make: it would look at all that was collected each time."""
    gc.freeze()
    gc.enable()
    gc.freeze, gc.unfreeze = _noting(gc.freeze, frozen=True), _noting(gc.unfreeze, frozen=False)


def _noting(function, *, frozen):
    """Return a function of the collector that notes whether it leaves objects aside."""

    @functools.wraps(function)
    def noted():
        function()
        FROZEN[0] = frozen

    return noted


def pytest_configure(config):
    """Keep programs that fixtures of a module or of the session start out of the user's own state directory."""
    folder = tempfile.TemporaryDirectory(prefix="autotuner-tests-")
    config.add_cleanup(folder.cleanup)
    os.environ["XDG_STATE_HOME"] = folder.name
    os.environ.setdefault(COMPUTED, folder.name)  # that of the first process, which the workers of a run inherit


def pytest_asyncio_loop_factories(config, item):
    """Run `async def` tests marked `virtual_time` on a loop whose clock jumps to the next timer."""
    virtual = item.get_closest_marker("virtual_time") is not None
    return {"virtual": async_solipsism.EventLoop} if virtual else {"wall": asyncio.new_event_loop}


@pytest.fixture(autouse=True)
def state(monkeypatch, tmp_path_factory):
    """Give each test a state directory of its own, also for the programs that it starts."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))


@pytest.fixture(autouse=True, scope="session")
def computed_once():
    """Compute each result of a pure computation once a run of all workers, and give each caller a copy.

    The search for gains too, where a specification asks for it: reports, choices and restarts ask for the same gains.
    The tests of the search itself call it past this.
    """
    folder, run, tune = Path(os.environ[COMPUTED]), InPlace.run, design_procedure.tune

    async def run_once(self, function, /, *args, **kwargs):
        if function.__module__ != "autotuner.application.computing.computations":
            return await run(self, function, *args, **kwargs)
        diagnosed = procedure.diagnose.__qualname__  # another one, where a test leaves it out
        file = _result_of(folder, function.__qualname__, args, kwargs, os.environ.get(ARTEFACTS), diagnosed)
        return _read(file) if file.exists() else _kept(file, await run(self, function, *args, **kwargs))

    def tune_once(*args, **kwargs):
        file = _result_of(folder, "tune", args, kwargs)
        return _read(file) if file.exists() else _kept(file, tune(*args, **kwargs))

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(plugins, "entry_points", functools.cache(plugins.entry_points))  # as at the start
        patched.setattr(InPlace, "run", run_once)
        patched.setattr(design_procedure, "tune", tune_once)
        yield


@pytest.fixture
def without_diagnosis(monkeypatch):
    """Leave out the diagnosis of a tuning's record, half the time of an analysis, where a test judges the tuning."""

    def no_diagnosis(*_args, **_kwargs):
        raise InputError("is left out by this test", field="recording", remedy="None.")

    monkeypatch.setattr(procedure, "diagnose", no_diagnosis)


def _result_of(folder, *question):
    """Return the file of a computation's result."""
    return folder / hashlib.sha256(pickle.dumps(question)).hexdigest()


def _read(file):
    return pickle.loads(file.read_bytes())  # noqa: S301 - its own pickle


def _kept(file, result):
    """Return a copy of a result, written in one go: another worker may compute the same. A test may fill the disk."""
    begun, copy = file.with_suffix(f".{os.getpid()}"), pickle.dumps(result)
    with contextlib.suppress(OSError):
        begun.write_bytes(copy)
        begun.replace(file)
    return pickle.loads(copy)  # noqa: S301 - its own pickle


@pytest.fixture
def virtual():
    """Return a function that runs a coroutine in virtual time: for tests that are no coroutines themselves."""

    def run(main):
        with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
            return runner.run(main)

    return run


@pytest.fixture
def closes():
    """Return a function that says what a closed terminal does to this process, and to programs that it starts."""
    before = signal.getsignal(signal.SIGHUP)
    yield lambda handler: signal.signal(signal.SIGHUP, handler)
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(autouse=True)
def leaks(request, monkeypatch):
    """Take note of what is running before the test, and of every task that is still alive when its loop is closed."""
    cancel = asyncio.runners._cancel_all_tasks
    tasks = []

    def note_and_cancel(loop):
        tasks.extend(asyncio.all_tasks(loop))
        cancel(loop)

    monkeypatch.setattr(asyncio.runners, "_cancel_all_tasks", note_and_cancel)
    request.node.stash[BEFORE] = (_running(), tasks, _state())


@pytest.hookimpl(wrapper=True, trylast=True)
def pytest_runtest_teardown(item):
    """Compare when all fixtures of the test are gone."""
    yield
    if BEFORE not in item.stash:
        return
    before, tasks, state = item.stash[BEFORE]
    left = [f"task {task.get_name()}: {task.get_coro()!r}" for task in tasks]
    left += [f"{kind} {thing}" for kind, thing in _left(before)]
    now = _state()
    left += [f"another {name}" for name in now.keys() | state.keys() if now.get(name) != state.get(name)]
    if left:
        pytest.fail("left behind: " + "; ".join(sorted(left)), pytrace=False)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session, exitstatus):
    """Keep how the run ended for the last moment."""
    session.config.stash[STATUS] = int(exitstatus)


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config):
    """End although a thread was left behind: it has failed its test, and must not keep the whole run from ending."""
    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    if STATUS in config.stash and not all(_ends(thread) for thread in others if not thread.daemon):
        sys.stdout.flush()
        os._exit(config.stash[STATUS] or 1)


def _running():
    """Return every thread, worker process, open socket and pseudo-terminal of this process."""
    return {
        *(("thread", thread) for thread in threading.enumerate()),
        *(("worker process", worker) for worker in multiprocessing.active_children()),
        *(
            ("open file", target)
            for target in _open_files()
            if target.startswith(("socket:", "/dev/pts/", "/dev/ptmx"))
        ),
    }


def _state():
    """Return what belongs to the whole process, and would be met by every later test."""
    root = logging.getLogger()
    return {
        "level of the log": root.level,
        "handlers of the log": [handler for handler in root.handlers if not _of_pytest(handler)],
        "folder": _folder(),
        "collector": (gc.isenabled(), gc.get_threshold(), FROZEN[0]),
        "switch interval": sys.getswitchinterval(),
        "module search path": tuple(sys.path),
        "umask": _umask(),
        **{f"handler of {number.name}": signal.getsignal(number) for number in SIGNALS},
        **{f"variable {name}": value for name, value in os.environ.items() if not name.startswith(THEIRS)},
    }


def _of_pytest(handler):
    return type(handler).__module__.startswith("_pytest.")


def _folder():
    try:
        return Path.cwd()
    except OSError:
        return "gone"


def _umask():
    mask = os.umask(0o022)
    os.umask(mask)
    return mask


def _open_files():
    """Yield what each open file is, where /proc tells."""
    for link in os.listdir(OPEN_FILES) if os.path.isdir(OPEN_FILES) else ():  # noqa: PTH112, PTH208 - before each test
        with contextlib.suppress(OSError):  # the listing's own handle is gone already
            yield os.readlink(f"{OPEN_FILES}/{link}")  # noqa: PTH115 - and after it


def _left(before):
    """Return what was not there before and stays; a file is looked at again when what may close it has ended."""
    new = _running() - before
    return {one for one in new if not _ends(one[1])} & _running()


def _ends(thing):
    """Give a thread or a worker process that is on its way out a moment; nothing else goes away by itself.

    A process is looked at by its sentinel, which tells its end whoever waits for it: what two threads wait for at once
    may seem alive to either.
    """
    if isinstance(thing, threading.Thread):
        thing.join(GRACE_S)
        return not thing.is_alive()
    if isinstance(thing, multiprocessing.process.BaseProcess):
        with contextlib.suppress(ValueError):  # closed, and so ended
            return bool(multiprocessing.connection.wait([thing.sentinel], GRACE_S))
        return True
    return False
