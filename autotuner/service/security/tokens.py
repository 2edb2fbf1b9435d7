"""Bearer tokens for access to the service, stored as hashes in the data directory.

Invariants:

1. A token is 256 random bits and is shown once; only its SHA-256 is stored, which reveals nothing of it.
2. A revoked token stays in the file, so that its name is not given to another client unnoticed.
3. The file is written atomically, readable by its owner only, and read again when it has changed: a
   revoked token is invalid from the next request on.
4. Access fails closed: once a token was required, a file that is missing, empty or unreadable admits no client.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import logging
import secrets
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from autotuner.control.clock.ticker import utc_now
from autotuner.control.records.atomic_file import write_whole
from autotuner.errors import ConfigurationError, InputError, StorageError

if TYPE_CHECKING:
    from collections.abc import Sequence

FILE = "tokens.json"

_log = logging.getLogger(__name__)


class Role(StrEnum):
    """Permissions of a token: a viewer reads, an operator moves outputs and writes gains too."""

    VIEWER = "viewer"
    OPERATOR = "operator"


@dataclass(frozen=True, slots=True)
class Token:
    """A token without its secret.

    Attributes
    ----------
    name : str
        Whose it is.
    role : Role
        What it allows.
    sha256 : str
        Of the secret, in hex.
    made_at : str
        When it was made, ISO 8601 in UTC.
    revoked_at : str or None
        When it was revoked.
    """

    name: str
    role: Role
    sha256: str
    made_at: str
    revoked_at: str | None = None


class Tokens:
    """The tokens of one data directory.

    Parameters
    ----------
    folder : Path
        The data directory; made when the first token is added.
    required : bool
        Whether a token is required even while none exists: beyond loopback.
    """

    def __init__(self, folder: Path, *, required: bool = False) -> None:
        self._path = folder / FILE
        self._version: tuple[int, int, int] | None = None
        self._tokens: tuple[Token, ...] = ()
        self._required = required
        self._trouble: str | None = None

    @property
    def required(self) -> bool:
        """Whether requests need a token: from the first one that this program saw, whatever becomes of the file.

        Raises
        ------
        StorageError
            The file cannot be used: access is closed.
        """
        return bool(self.all())

    def all(self) -> tuple[Token, ...]:
        """Return every token, the oldest first.

        Raises
        ------
        StorageError
            The file cannot be read, or it has no token although one was required before.
        """
        try:
            tokens = self._current()
            if not tokens and self._required:
                raise _unusable("it has no token any more, so no client is admitted")
        except StorageError as error:
            self._report(error.message)
            raise
        self._required = bool(tokens)
        self._report(None)
        return tokens

    def _current(self) -> tuple[Token, ...]:
        """Return the present content of the file; empty without a file."""
        try:
            status = self._path.stat()
        except FileNotFoundError:
            self._version = None
            return ()
        except OSError as error:
            raise _unusable(str(error.strerror)) from error
        version = (status.st_mtime_ns, status.st_size, status.st_ino)
        if self._version != version:
            self._version = None
            self._tokens, self._version = _read(self._path), version
        return self._tokens

    def _report(self, trouble: str | None) -> None:
        """Log that access was closed or opened, once for each change."""
        if trouble == self._trouble:
            return
        self._trouble = trouble
        if trouble is None:
            _log.warning("access is open again: %s holds tokens", self._path)
        else:
            _log.error("access is closed: %s %s", self._path, trouble)

    def holder(self, secret: str) -> Token | None:
        """Return the token that a secret belongs to; None for an unknown or revoked one."""
        given = _hash(secret)
        found = None
        for token in self.all():  # all of them, so that the time reveals nothing
            if hmac.compare_digest(token.sha256, given) and token.revoked_at is None:
                found = token
        return found

    def add(self, name: str, role: Role) -> str:
        """Make a token and return its secret, which is kept nowhere; raise `InputError` for a name in use."""
        if not name or not name.isprintable():
            raise InputError("must be a name", field="name", value=name, remedy="Name the person or the program.")
        if any(token.name == name for token in self.all()):
            raise InputError("is the name of another token", field="name", value=name, remedy="Choose another name.")
        secret = secrets.token_urlsafe(32)
        self._write([*self.all(), Token(name, role, _hash(secret), utc_now())])
        return secret

    def revoke(self, name: str) -> None:
        """Revoke a token; raise `InputError` when there is none of this name."""
        if not any(token.name == name and token.revoked_at is None for token in self.all()):
            raise InputError("is no valid token", field="name", value=name, remedy="List them: autotuner token list.")
        now = utc_now()
        self._write([replace(token, revoked_at=now) if token.name == name else token for token in self.all()])

    def _write(self, tokens: Sequence[Token]) -> None:
        text = json.dumps([asdict(token) for token in tokens], indent=1)
        try:
            write_whole(self._path, text.encode(), mode=0o600, sync=True)
        except OSError as error:
            raise _unusable(str(error.strerror)) from error
        self._version = None


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


def _read(path: Path) -> tuple[Token, ...]:
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(rows, list):
            raise TypeError("no list of tokens")  # noqa: TRY301 - as any other content that is not ours
        return tuple(Token(**{**row, "role": Role(row["role"])}) for row in rows)
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise _unusable(f"it cannot be read ({type(error).__name__})") from error


def _unusable(why: str) -> StorageError:
    """Return the error, without the path: clients without a token see it too."""
    return StorageError(
        f"cannot be used: {why}", field=FILE, remedy="Restore the file in the data directory, readable by the service."
    )


def tokens_of(data_directory: str, *, required: bool = False) -> Tokens:
    """Return the tokens of a data directory; see `Tokens`."""
    return Tokens(Path(data_directory), required=required)


def require_protection(host: str, *, loopback: bool, tokens: Tokens) -> None:
    """Refuse to listen where other machines reach while no token is required.

    Raises
    ------
    ConfigurationError
        Names ``service.host``.
    """
    if not loopback and not tokens.required:
        raise ConfigurationError(
            "is not a loopback address, there is no token, and any client that reaches it can move an actuator",
            field="service.host",
            value=host,
            remedy="Use 127.0.0.1, ::1 or localhost; or make tokens: autotuner token add NAME --role operator.",
        )
