"""A Modbus TCP server that answers as fast as it can: registers all 7, writes echoed. A process of its own.

It looks for requests without ever sleeping, and so takes a core. To wake a process that sleeps costs whoever sends to
it, here the loops that are measured; a device that is another machine costs its client nothing of that kind.

python benchmarks/scale/_quick_plc.py
"""

import selectors
import socket
import sys

HEADER = 6
MOST_BYTES = 65536


class Quick:
    """One connection."""

    def __init__(self, connection):
        self._connection, self._rest = connection, b""
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def serve(self):
        """Answer what has come; return whether the connection is still there."""
        try:
            if not (data := self._connection.recv(MOST_BYTES)):
                return False
            self._connection.sendall(b"".join(self._answers(data)))
        except OSError:
            return False
        return True

    def _answers(self, data):
        data = self._rest + data
        while len(data) >= HEADER and len(data) >= (end := HEADER + int.from_bytes(data[4:6], "big")):
            frame, data = data[:end], data[end:]
            told = frame[6:12]
            if frame[7] in {3, 4}:
                size = 2 * int.from_bytes(frame[10:12], "big")
                told = bytes((frame[6], frame[7], size)) + b"\0\7" * (size // 2)
            yield frame[:4] + len(told).to_bytes(2, "big") + told
        self._rest = data


def main():
    with socket.create_server(("127.0.0.1", 0), backlog=2000) as listener, selectors.DefaultSelector() as selector:
        print(listener.getsockname()[1], flush=True)
        selector.register(listener, selectors.EVENT_READ)
        selector.register(sys.stdin, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select(0):
                if key.fileobj is sys.stdin:  # who started it is done
                    return
                if key.fileobj is listener:
                    connection, _ = listener.accept()
                    selector.register(connection, selectors.EVENT_READ, Quick(connection))
                elif not key.data.serve():
                    selector.unregister(key.fileobj)
                    key.fileobj.close()


if __name__ == "__main__":
    main()
