"""A Modbus TCP server that answers as fast as it can: registers all 7, writes echoed. A process of its own.

On uvloop, whose event loop is C, where that is installed.

python benchmarks/_quick_plc.py
"""

import asyncio
import sys


class Quick(asyncio.Protocol):
    def connection_made(self, transport):
        self._transport, self._rest = transport, b""

    def data_received(self, data):
        data, answers = self._rest + data, []
        while len(data) >= 8 and len(data) >= (end := 6 + int.from_bytes(data[4:6], "big")):
            frame, data = data[:end], data[end:]
            if frame[7] in {3, 4}:
                size = 2 * int.from_bytes(frame[10:12], "big")
                told = bytes((frame[6], frame[7], size)) + b"\0\7" * (size // 2)
            else:
                told = frame[6:12]
            answers.append(frame[:4] + len(told).to_bytes(2, "big") + told)
        self._rest = data
        self._transport.write(b"".join(answers))


async def main():
    server = await asyncio.get_running_loop().create_server(Quick, "127.0.0.1", 0, backlog=2000)
    print(server.sockets[0].getsockname()[1], flush=True)
    await asyncio.to_thread(sys.stdin.read)  # until the one who started it is done


def event_loop():
    try:
        import uvloop  # noqa: PLC0415 - where it is installed
    except ImportError:
        return asyncio.new_event_loop()
    return uvloop.new_event_loop()


if __name__ == "__main__":
    with asyncio.Runner(loop_factory=event_loop) as runner:
        runner.run(main())
