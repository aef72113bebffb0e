"""The views that the stage ``monoplane`` tracks, and their parts of its key.

After a correction the keys of all sites are compared. The frames of a site are long, and its points are many, so a process
computes their hashes once.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

from fluoromap.catheters import Catalogue
from fluoromap.contracts import APriori, Array, ElectrodePoint, MatchedSite, MonoplaneView, Observation, SiteCycle, View
from fluoromap.geometry import Camera
from fluoromap.reasons import Reason
from fluoromap_service.store.codec import block_hash, plain_form, undecoded

NAME_DOUBTS = frozenset({Reason.IDENTITY_BY_MOTION, Reason.IDENTITY_UNCERTAIN})
_REMEMBERED_HASHES = 8192


@dataclass(frozen=True, eq=False)
class TrackedView:
    """One view of one site, whose frames and points are decoded only where somebody needs them.

    matched : the site with the frames of both views. a_priori : the site's points; their doubts about names do not count. The
    other fields are those of :class:`fluoromap.contracts.MonoplaneView`.
    """

    matched: MatchedSite
    view: View
    camera: Camera
    catalogue: Catalogue
    a_priori: APriori
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
            a_priori=_points(self.a_priori).points,
            a_priori_frame=self.a_priori_frame,
            cycle=self.cycle,
            others=self.others,
        )

    def content(self) -> bytes:
        """Return bytes that are equal for equal decoded views.

        Frames and points count with their hashes.
        """
        hashes: dict[str, Any] = {
            "frames_sha256": _hashes.of(
                (block_hash(self.matched.runs), f"{self.matched.site}-{self.view}"),
                partial(_frames, self.matched, self.view),
            ),
            "points_sha256": _hashes.of((block_hash(self.a_priori), "a_priori"), partial(_points, self.a_priori)),
        }
        values = {field.name: getattr(self, field.name) for field in fields(_Content) if field.name not in hashes}
        return plain_form(_Content(**values, **hashes))


@dataclass(frozen=True, eq=False)
class _Content:
    """A tracked view, with the hashes of its frames and its points in their places."""

    view: View
    camera: Camera
    catalogue: Catalogue
    a_priori_frame: int
    cycle: SiteCycle | None
    others: tuple[SiteCycle, ...]
    frames_sha256: str
    points_sha256: str


@dataclass(frozen=True, eq=False)
class _Frames:
    """The part of a matched site that shows one view: frame_times_ms (n,), and an observation for each frame."""

    site: str
    frame_times_ms: Array
    observations: tuple[Observation, ...]


def _frames(matched: MatchedSite, view: View) -> _Frames:
    # The worker remembers the runs, so it would keep the decoded frames of all sites.
    runs = undecoded(matched.runs)
    if view == "a":
        return _Frames(matched.site, runs.frame_times_a_ms, runs.track_a)
    return _Frames(matched.site, runs.frame_times_b_ms, runs.track_b)


def _points(a_priori: APriori) -> APriori:
    """Return the points without doubts about their names.

    They move no electrode, and naming a catheter at one site must not redo the others.
    """
    # As with the frames: the worker remembers the points.
    return APriori(tuple(map(_without_name_doubts, undecoded(a_priori).points)))


def _without_name_doubts(point: ElectrodePoint) -> ElectrodePoint:
    if NAME_DOUBTS.isdisjoint(point.reasons):
        return point
    # Not by replace, which checks the arrays again: most points of a study have such doubts.
    certain = copy(point)
    object.__setattr__(certain, "reasons", tuple(reason for reason in point.reasons if reason not in NAME_DOUBTS))
    return certain


class _Hashes:
    """The hashes of frames and points, by the hashes of the stored values that hold them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._remembered: OrderedDict[tuple[str | None, str], str] = OrderedDict()

    def of(self, name: tuple[str | None, str], read: Callable[[], Any]) -> str:
        """Return the hash of the value of a name; ``read`` returns the value."""
        with self._lock:
            known = self._remembered.get(name)
        if known is None:
            known = hashlib.sha256(plain_form(read())).hexdigest()
        with self._lock:
            self._remembered[name] = known
            self._remembered.move_to_end(name)
            while len(self._remembered) > _REMEMBERED_HASHES:
                self._remembered.popitem(last=False)
        return known


_hashes = _Hashes()
