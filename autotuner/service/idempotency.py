"""Requests that are sent twice: a start with an `Idempotency-Key` is done once, however often it arrives.

Invariants:

1. The same key with another request is refused, never answered with the first one's tuning.
2. Looking a key up and starting is one step: two requests that arrive together are one.
3. A key is on the disk, with the identifier that its tuning will have, before the tuning is started. So it survives a
   kill at any moment: the same request then gets that tuning, or starts it when it had not been.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
from collections import OrderedDict
from typing import TYPE_CHECKING

from pydantic import BaseModel, TypeAdapter, ValidationError

from autotuner.control.records.atomic_file import write_whole
from autotuner.errors import InputError, StorageError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from pathlib import Path

REMEMBERED = 1000
"""Keys remembered; the oldest go first."""

_log = logging.getLogger(__name__)


class Start(BaseModel, frozen=True):
    """A start: the SHA-256 of its request, and the identifier of its tuning."""

    request: str
    tuning_id: str


_FORM = TypeAdapter(dict[str, Start])


class IdempotencyKeys:
    """Which tuning was started under which key.

    Parameters
    ----------
    path : Path
        The file that keeps them.
    in_place : bool
        Whether to write in the caller's thread: for virtual time.
    """

    def __init__(self, path: Path, *, in_place: bool = False) -> None:
        self._path, self._in_place = path, in_place
        self._starts: OrderedDict[str, Start] | None = None
        self._turn = asyncio.Lock()

    async def once(
        self,
        key: str,
        request: str,
        new_id: Callable[[], str],
        start: Callable[[str], Awaitable[str]],
        is_known: Callable[[str], Awaitable[bool]],
    ) -> str:
        """Return the tuning of this request: started now, or by the same request before.

        Raises
        ------
        InputError
            The key was used for another request.
        StorageError
            The key cannot be kept: nothing is started.
        """
        digest = hashlib.sha256(request.encode()).hexdigest()
        async with self._turn:
            starts = self._starts = self._read() if self._starts is None else self._starts
            if key in starts:
                self._require_same(key, digest)
                if await is_known(starts[key].tuning_id):
                    return starts[key].tuning_id
            else:
                starts[key] = Start(request=digest, tuning_id=new_id())
                await self._write()
            try:
                return await start(starts[key].tuning_id)
            except Exception:
                del starts[key]  # refused: the same key may be sent again, with a request that is not
                raise

    def _require_same(self, key: str, digest: str) -> None:
        assert self._starts is not None  # noqa: S101 - read
        if self._starts[key].request != digest:
            raise InputError(
                "was used for another request",
                field="Idempotency-Key",
                value=key,
                remedy="Make a new key for each tuning, and send it again only with the same request.",
            )

    def _read(self) -> OrderedDict[str, Start]:
        try:
            return OrderedDict(_FORM.validate_json(self._path.read_bytes()))
        except FileNotFoundError:
            return OrderedDict()
        except (OSError, ValidationError) as error:
            _log.warning("%s cannot be read, requests of earlier runs are not known again: %s", self._path, error)
            return OrderedDict()

    async def _write(self) -> None:
        assert self._starts is not None  # noqa: S101 - read
        while len(self._starts) > REMEMBERED:
            self._starts.popitem(last=False)
        data = _FORM.dump_json(dict(self._starts))
        try:
            if self._in_place:
                write_whole(self._path, data)
            else:
                await asyncio.to_thread(write_whole, self._path, data, mode=0o600, sync=True)
        except OSError as error:
            self._starts.popitem()
            raise StorageError(
                f"cannot be written: {error.strerror}", field=self._path.name, remedy="Make room on that disk."
            ) from error
