"""The views that the stage ``monoplane`` tracks, and their parts of its key.

After a correction the keys of all sites are compared. The frames of a site are long, so a process computes their hash once.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from dataclasses import dataclass, fields

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, ElectrodePoint, MatchedSite, MonoplaneView, Observation, SiteCycle, View
from fluoromap.geometry import Camera
from fluoromap_service.store.codec import block_hash, plain_form, undecoded

_REMEMBERED_HASHES = 8192


@dataclass(frozen=True, eq=False)
class TrackedView:
    """One view of one site, whose frames are decoded only where somebody needs them.

    matched : the site with the frames of both views. The other fields are those of :class:`fluoromap.contracts.MonoplaneView`.
    """

    matched: MatchedSite
    view: View
    camera: Camera
    catalogue: Catalogue
    a_priori: tuple[ElectrodePoint, ...]
    a_priori_frame: int
    cycle: SiteCycle | None
    others: tuple[SiteCycle, ...]

    def decoded(self) -> MonoplaneView:
        """Return the view with its frames, as a solver gets it."""
        frames = _frames(self.matched, self.view)
        return MonoplaneView(
            site=self.matched.site,
            view=self.view,
            camera=self.camera,
            catalogue=self.catalogue,
            frame_times_ms=frames.frame_times_ms,
            observations=frames.observations,
            a_priori=self.a_priori,
            a_priori_frame=self.a_priori_frame,
            cycle=self.cycle,
            others=self.others,
        )

    def content(self) -> bytes:
        """Return bytes that are equal for equal decoded views.

        The frames count with their hash.
        """
        values = {field.name: getattr(self, field.name) for field in fields(_Content) if field.name != "frames_sha256"}
        return plain_form(_Content(**values, frames_sha256=_hashes.of(self.matched, self.view)))


@dataclass(frozen=True, eq=False)
class _Content:
    """A tracked view, with the hash of its frames in their place."""

    view: View
    camera: Camera
    catalogue: Catalogue
    a_priori: tuple[ElectrodePoint, ...]
    a_priori_frame: int
    cycle: SiteCycle | None
    others: tuple[SiteCycle, ...]
    frames_sha256: str


@dataclass(frozen=True, eq=False)
class _Frames:
    """The part of a matched site that shows one view: frame_times_ms (n,), and an observation for each frame."""

    site: str
    frame_times_ms: Array
    observations: tuple[Observation, ...]


def _frames(matched: MatchedSite, view: View) -> _Frames:
    # The worker remembers the site, so it would keep the decoded frames of all sites.
    site = undecoded(matched)
    if view == "a":
        return _Frames(site.site, site.frame_times_a_ms, site.track_a)
    return _Frames(site.site, site.frame_times_b_ms, site.track_b)


class _FrameHashes:
    """The hashes of the frames of a matched site's views, by the hash of the site."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._remembered: OrderedDict[tuple[str | None, View], str] = OrderedDict()

    def of(self, matched: MatchedSite, view: View) -> str:
        """Return the hash of the frames of one view."""
        name = block_hash(matched), view
        with self._lock:
            known = self._remembered.get(name)
        if known is None:
            known = hashlib.sha256(plain_form(_frames(matched, view))).hexdigest()
        with self._lock:
            self._remembered[name] = known
            self._remembered.move_to_end(name)
            while len(self._remembered) > _REMEMBERED_HASHES:
                self._remembered.popitem(last=False)
        return known


_hashes = _FrameHashes()
