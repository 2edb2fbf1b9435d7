"""A loop process as a task of the same event loop, in virtual time, with a wire in memory."""

import asyncio

from autotuner.control.operations.loop_process import serve


class Pipe:
    """One end of a wire in memory."""

    def __init__(self, incoming, outgoing):
        self.incoming, self.outgoing = incoming, outgoing

    def send(self, message):
        self.outgoing.put_nowait(message)

    async def receive(self):
        return await self.incoming.get()

    async def close(self):
        pass


class Process:
    """A lane to an operation as a task, on a device of its own."""

    def __init__(self, order, backend, journal=None):
        to, back = asyncio.Queue(), asyncio.Queue()
        self.wire, self.theirs = Pipe(back, to), Pipe(to, back)
        self.ended, self.served, self.gone = None, None, False
        self.backend = backend
        self.task = asyncio.create_task(serve(order, backend, self.theirs, journal, self._begun))

    def _begun(self, served):
        self.served = served

    def lose_front(self):
        """Be without a front, as after its `kill -9`: nobody takes what is sent, and nothing comes."""
        self.theirs.incoming.put_nowait(None)

    def vanish(self):
        """Be gone, as after `kill -9`: nothing is sent any more, and nothing done."""
        self.gone = True
        self.theirs.outgoing = asyncio.Queue()
        self.wire.incoming.put_nowait(None)

    async def end(self, *, at_once):
        self.ended = "SIGKILL" if at_once else "exit code 0"
        if not at_once:
            await self.task
        return self.ended
