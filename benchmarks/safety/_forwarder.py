"""Stands between a client and a device, forwards their bytes, and goes away when told: a process of its own.

    python benchmarks/safety/_forwarder.py PORT TARGET

Takes one connection at a time. On a line of standard input, FIN or RST, it closes the connection that way, listens no
more, and tells the moment before, s on the system's clock.
"""

import select
import socket
import sys
import time

LINGER = bytes((1, 0, 0, 0, 0, 0, 0, 0))
"""struct linger {on, 0 s}: the close sends RST."""


def pass_on(near, far):
    """Forward until either side closes, or a word comes; return the word."""
    while True:
        ready, _, _ = select.select([near, far, sys.stdin], [], [])
        if sys.stdin in ready:
            return sys.stdin.readline().strip()
        for one, other in ((near, far), (far, near)):
            if one in ready:
                data = one.recv(4096)
                if not data:
                    return ""
                other.sendall(data)


def main():
    port, target = map(int, sys.argv[1:])
    listener = socket.create_server(("127.0.0.1", port))
    print("listening", flush=True)
    while True:
        near, _ = listener.accept()
        far = socket.create_connection(("127.0.0.1", target))
        for one in (near, far):
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if word := pass_on(near, far):
            break
        near.close()
        far.close()
    if word == "RST":
        near.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER)
    listener.close()
    moment_s = time.monotonic()
    near.close()
    print(moment_s, flush=True)


if __name__ == "__main__":
    main()
