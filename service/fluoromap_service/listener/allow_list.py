"""The senders that may open an association: application entity titles, each from any address or from one network."""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass

from fluoromap_service.problem import Problem

Network = ipaddress.IPv4Network | ipaddress.IPv6Network

_TITLE = re.compile(r"[ -\[\]-~]{1,16}")  # VR AE: PS3.5 section 6.2


@dataclass(frozen=True, slots=True)
class Sender:
    """A sender by its application entity title; ``network`` None means any address."""

    title: str
    network: Network | None


@dataclass(frozen=True, slots=True)
class AllowList:
    """The senders of the listener; without any entry every program of the same machine may send."""

    senders: tuple[Sender, ...]

    @classmethod
    def from_text(cls, text: str) -> AllowList:
        """Read entries with commas between.

        An entry is ``AET`` or ``AET@address``. The address may be a network, as 10.1.0.0/16.

        Raises
        ------
        Problem
            422 ``invalid_sender`` for an entry of another form.
        """
        return cls(tuple(_sender(entry.strip()) for entry in text.split(",") if entry.strip()))

    def allows(self, title: str, address: str) -> bool:
        """Return whether a sender may open an association from an address."""
        if not self.senders:
            return True
        peer = ipaddress.ip_address(address.partition("%")[0])
        if isinstance(peer, ipaddress.IPv6Address) and peer.ipv4_mapped is not None:
            peer = peer.ipv4_mapped
        return any(
            sender.title == title.strip() and (sender.network is None or peer in sender.network)
            for sender in self.senders
        )


def _sender(entry: str) -> Sender:
    title, at, address = entry.rpartition("@") if "@" in entry else (entry, "", "")
    title = title.strip()
    try:
        network = ipaddress.ip_network(address.strip(), strict=False) if at else None
    except ValueError:
        network, title = None, ""
    if not _TITLE.fullmatch(title):
        raise Problem(
            422,
            "invalid_sender",
            f"The sender {entry!r} of the allow-list is not usable; write AET or AET@address, as XA_ROOM_1@192.0.2.7.",
        )
    return Sender(title, network)
