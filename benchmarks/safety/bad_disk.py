"""A disk that is full, and one that can only be read, in the middle of a tuning: is the loop disturbed?

    python benchmarks/safety/bad_disk.py          # Linux, root: it makes a disk of its own

A simulated PLC and the service are separate programs, on the wall clock; the data directory is an ext4 of 120 MiB in a
file. Each round starts a tuning and harms the disk in its relay phase: it is filled to the last byte, or the
kernel finds an error in it, on which it makes the file system read-only. Then another tuning is asked for, the
end is waited for, the PLC is looked at with another's client, and the disk is mended: by making room, or by stopping
the service, checking the disk and starting again. Told are in the end the samples that the database has.
"""

import contextlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx

from benchmarks.safety.kills import CONFIGURATION, LOOP, PATIENCE_S, Plc, looked_into, serve, until

SIZE = 120 * 2**20
OTHER = """
[loops.other]
driver = "simulated"
sample_time_s = 0.1
device = {{ plant = {{ structure = "fopdt", K = 2.0, T = 60.0, D = 9.0 }} }}
"""


def run(*words):
    return subprocess.run(words, check=True, capture_output=True, text=True).stdout.strip()  # noqa: S603 - our own words


class Disk:
    """An ext4 in a file, mounted at a folder."""

    def __init__(self, stack, folder, size=SIZE):
        self.folder = folder
        image = folder.with_suffix(".img")
        with image.open("wb") as file:
            file.truncate(size)
        run("mkfs.ext4", "-q", "-m", "0", str(image))
        self.device = run("losetup", "--find", "--show", str(image))
        stack.callback(run, "losetup", "--detach", self.device)
        self.mount()
        stack.callback(run, "umount", "--lazy", str(folder))

    def mount(self):
        run("mount", "-o", "errors=remount-ro", self.device, str(self.folder))

    def fill(self):
        for piece in (2**20, 2**12, 1):
            with contextlib.suppress(OSError), (self.folder / "filler").open("ab", buffering=0) as file:
                while True:
                    file.write(bytes(piece))

    def make_room(self):
        (self.folder / "filler").unlink()

    def refuse(self):
        (Path("/sys/fs/ext4") / Path(self.device).name / "trigger_fs_error").write_text("1")

    def repair(self):
        run("umount", str(self.folder))
        subprocess.run(["fsck.ext4", "-y", self.device], check=False, capture_output=True)  # noqa: S603, S607
        self.mount()


def harmed(url, plc, harm):
    """Start a tuning, harm the disk in its relay phase; return what it told at its end, and a line about it."""
    path = httpx.post(f"{url}/v1/loops/{LOOP}/tunings", timeout=PATIENCE_S).raise_for_status().headers["location"]

    def told():
        return httpx.get(f"{url}{path}", timeout=PATIENCE_S).json()

    until(lambda: told()["phase"] == "relay")
    harm()
    time.sleep(2.0)
    other = httpx.post(f"{url}/v1/loops/other/tunings", timeout=PATIENCE_S)
    ready = httpx.get(f"{url}/readyz", timeout=PATIENCE_S)
    ended = until(lambda: (now := told())["state"] == "ended" and now)
    verdict, late = ended["verdict"], 1e3 * ended["lateness"]["max_s"]
    return ended, (
        f"  another start: {other.status_code}, {other.json()['detail']}\n  /readyz: {ready.status_code}\n"
        f"  tuning: {verdict['outcome']} ({verdict['code']}), {ended['samples']} samples, {late:.1f} ms late at most\n"
        f"  given back: by its own word {ended['restored']}, by the PLC {plc.as_found}"
    )


def kept(url, folder, ended):
    """Return a line about what is kept of a tuning."""
    until(lambda: httpx.get(f"{url}/readyz", timeout=PATIENCE_S).is_success)
    time.sleep(2.0)
    whole, last_s = looked_into(folder / "tunings.sqlite", ended["id"])
    told = httpx.get(f"{url}/v1/tunings/{ended['id']}", timeout=PATIENCE_S).json()
    shown = f"{told['verdict']['code']}, {told['samples']} samples"
    return f"  mended: database {whole}, samples up to {last_s:.2f} s; the service tells {shown}"


def main():
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (folder / "data").mkdir()
        disk = Disk(stack, folder / "data")
        plc = Plc(stack)
        config = folder / "loops.toml"
        config.write_text((CONFIGURATION + OTHER).format(folder=folder, port=plc.port))
        service, url = serve(stack, config)
        ended, line = harmed(url, plc, disk.fill)
        disk.make_room()
        print(f"full\n{line}\n{kept(url, disk.folder, ended)}", flush=True)
        time.sleep(10.0)  # the loop rests again
        ended, line = harmed(url, plc, disk.refuse)
        service.terminate()
        print(f"read-only\n{line}\n  SIGTERM: exit code {service.wait(PATIENCE_S)}", flush=True)
        disk.repair()
        service, url = serve(stack, config)
        print(kept(url, disk.folder, ended))
        service.terminate()
        service.wait(PATIENCE_S)
    return 0


if __name__ == "__main__":
    sys.exit(main())
