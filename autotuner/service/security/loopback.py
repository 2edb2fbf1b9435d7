"""Which addresses only this machine reaches."""

from __future__ import annotations

import ipaddress

NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
"""Names under which a service on loopback is addressed."""


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches an address; a name other than localhost counts as reached by others."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
