"""A client that asks a service for paths in turns, so many times a second, in a process of its own."""

import http.client
import itertools
import subprocess
import sys
import time
from urllib.parse import urlsplit


def asked(url, paths, rate, seconds, *, wait=True):
    """Ask; return how many requests a second were answered, or a function that waits and returns that."""
    words = [sys.executable, "-S", __file__, url, str(rate), str(seconds), *paths]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)  # noqa: S603 - ourselves

    def answered():
        return float(process.communicate()[0])

    return answered() if wait else answered


def main():
    url, rate, seconds, *paths = sys.argv[1:]
    line, rate, seconds = http.client.HTTPConnection(urlsplit(url).netloc, timeout=30.0), float(rate), float(seconds)
    begun, count = time.monotonic(), 0
    for path in itertools.cycle(paths):
        line.request("GET", path)
        answer = line.getresponse()
        answer.read()
        count += answer.status == 200
        time.sleep(max(begun + (count + 1) / rate - time.monotonic(), 0.0))
        if time.monotonic() - begun >= seconds:
            break
    print(count / (time.monotonic() - begun))


if __name__ == "__main__":
    main()
