"""Requests for registers and their usual answers as bytes: encoded by the library once, the words filled in each time.

    transaction (2)   head: protocol, length, unit, function, address or byte count   words (2 each)

(Sizes in bytes.) The messages of one function, unit, address and count differ in transaction and words alone, so the
library encodes one request and one answer of each, and what it spends on a message is not spent on every one of many
loops at many hertz. Every other answer, such as a refusal, and all that is about bits, is the library's to decode.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from struct import Struct
from typing import TYPE_CHECKING, Final

from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU

from autotuner_drivers.modbus_requests import Request

if TYPE_CHECKING:
    from pymodbus.pdu import ModbusPDU

FRAMER: Final = FramerSocket(DecodePDU(is_server=False))
"""The library's encoder and decoder of Modbus TCP, as a client needs it."""

_WORDS: Final[dict[int, tuple[int, int]]] = {3: (0, 1), 4: (0, 1), 6: (1, 1), 16: (1, 0)}
"""Words in a request and in its answer, for each register, by function code; the others are about bits."""
_REMEMBERED: Final = 4096


@dataclass(frozen=True, slots=True)
class Form:
    """What a request and its usual answer have in common with all of their kind.

    Attributes
    ----------
    head, answer_head : bytes
        All between the transaction and the words.
    request, answer : Struct
        Transaction, head and words: the whole message.
    """

    head: bytes
    request: Struct
    answer_head: bytes
    answer: Struct

    def words_of(self, answer: bytes, transaction: int) -> tuple[int, ...] | None:
        """Return the words of the usual answer; None when the bytes are anything else."""
        if len(answer) != self.answer.size:
            return None
        parts = self.answer.unpack(answer)
        return parts[2:] if parts[0] == transaction and parts[1] == self.answer_head else None


@lru_cache(_REMEMBERED)
def form_of(function: int, unit: int, address: int, count: int) -> Form | None:
    """Return the form of a request; None for one about bits."""
    if function not in _WORDS:
        return None
    asked, told = (n * count for n in _WORDS[function])
    answer_type = FRAMER.decoder.lookupPduClass(bytes((unit, function)))
    assert answer_type is not None  # noqa: S101 - narrows the type: the library knows these functions
    request = Request(function, address, count, (0,) * asked).pdu(unit)
    answer = answer_type(dev_id=unit, address=address, count=count, registers=[0] * told)
    return Form(*_head(request, asked), *_head(answer, told))


def _head(message: ModbusPDU, words: int) -> tuple[bytes, Struct]:
    frame = FRAMER.buildFrame(message)
    head = frame[2 : len(frame) - 2 * words]
    return head, Struct(f">H{len(head)}s{words}H")
