"""Segmentation of a run: field, chains of every frame, tracks, diastole."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Chain, Context, FrameChains, Marks, Run, Segmentation
from fluoromap.reasons import Reason
from fluoromap.segmenter.judge.verdict import TrackJudge, Verdict
from fluoromap.segmenter.picture.field_mask import (
    ExposedField,
    FieldMask,
    evenly_spaced_frames,
    exposed_field,
    field_mask,
)
from fluoromap.segmenter.picture.lag import measure_lag
from fluoromap.segmenter.picture.log_image import Image, LogTransform
from fluoromap.segmenter.picture.moved_means import WINDOW_MS
from fluoromap.segmenter.picture.quiet_frames import MotionMeter, diastolic_frames
from fluoromap.segmenter.picture.shadowless_frames import ShadowlessFrames
from fluoromap.segmenter.places.ellipse import at_scale, rest_gain, with_jitter, with_lag, with_shape
from fluoromap.segmenter.places.oblique_places import place_obliquely
from fluoromap.segmenter.places.refinement import with_unexplained_profile
from fluoromap.segmenter.recall import Recall, recall_for
from fluoromap.segmenter.shape.chain_comparison import chain_distance, kind_overlap, overlaps, reverse
from fluoromap.segmenter.shape.limits import MANY_ELECTRODES
from fluoromap.segmenter.tracks.hidden_catheters import MovingSearch, add_hidden_catheters
from fluoromap.segmenter.tracks.still_frames import still_frames
from fluoromap.segmenter.tracks.track import ChainSearch
from fluoromap.segmenter.tracks.track_agreement import with_shape_of_track
from fluoromap.segmenter.tracks.tracking import track_chains

_SAME_PLACE_MM = 2.5
_SAME_TRACK_PX = 12.0
_EDGE_PX = 12
_SAME_MOMENT_MS = 40.0
_LEAST_MOVED = 5
_SURE_ROW = 1.0
"""Log-odds of the middle electrode of a long row that is not judged again."""


RunJudge = Callable[[Mapping[int, Chain], Callable[[int], Image], Recall[Any]], Verdict]
"""(frame -> chain of one track, frame -> log image, recall) -> whether the run shows a catheter there."""

PlaceObliquely = Callable[[int, tuple[Chain, ...]], tuple[Chain, ...]]
"""(frame, its chains) -> the chains at the places of :func:`~fluoromap.segmenter.places.oblique_places.place_obliquely`."""


class Detector(Protocol):
    """Search for chains in the log images of one run."""

    def find_chains(self, x: Image, frame: int, beside: Sequence[Image] = ()) -> FrameChains:
        """Return the chains of one log image.

        With ``manual_needed`` the chains are uncertain: they may continue a track but do not begin one.

        Parameters
        ----------
        x : (rows, columns) float32
            Log image.
        frame : int
        beside : sequence of (rows, columns) float32
            The frames before and after, where they show nearly the same moment.
        """

    def find_again(
        self,
        x: Image,
        chain: Chain,
        shift: Array,
        reach_px: float,
        taken: Sequence[Chain],
        frame: int | None = None,
        same_shape: bool = False,
        confirmed: bool = False,
    ) -> Chain | None:
        """Return a chain of another frame at its place in this log image.

        Parameters
        ----------
        x : (rows, columns) float32
            Log image.
        chain : Chain
            The catheter in another frame.
        shift : (2,)
            Expected displacement, pixels.
        reach_px : float
            Largest distance from the expected place.
        taken : sequence of Chain
            Other catheters that were already found in this image.
        frame : int, optional
            Number of the frame; None for a mean of frames.
        same_shape : bool
            Whether the electrodes must lie as in the other frame.
        confirmed : bool
            Whether means of several frames show the catheter. Then contrast alone decides whether this image shows it.

        Returns
        -------
        Chain or None
            None where the image does not show the chain, and from a detector that searches whole frames only.
        """

    def find_moving(self, images: Sequence[Image], times_ms: Array, middle: int, frame: int) -> tuple[Chain, ...]:
        """Return the chains that moved means show, most probable first.

        See :func:`~fluoromap.segmenter.picture.moved_means.moved_means`.

        Parameters
        ----------
        images : sequence of (rows, columns) float32
            Log images of successive frames.
        times_ms : (images,)
        middle : int
            Index of the image whose places the chains have.
        frame : int
            Its number in the run.

        Returns
        -------
        tuple of Chain
            No two have two electrodes in common. Empty from a detector that searches single frames only.
        """

    def shows_extra_catheter(self, x: Image, chains: Sequence[Chain]) -> bool:
        """Return whether the log image clearly shows a catheter besides these chains."""


@dataclass(frozen=True, eq=False)
class RunDetections:
    """The chains of a run's images, each found by itself and without any marks.

    frames : one entry a frame. motion : (n,), see :class:`~fluoromap.contracts.Segmentation`. mean : chains of the mean of the
    frames ``averaged`` round diastole.
    """

    frames: tuple[FrameChains, ...]
    motion: Array
    averaged: tuple[int, ...]
    mean: FrameChains


@dataclass(frozen=True, eq=False)
class RunTracks:
    """The tracked chains of a run without any marks, one entry a frame."""

    frames: tuple[FrameChains, ...]


@dataclass(frozen=True, eq=False)
class FoundAgain:
    """The answer of :meth:`Detector.find_again`."""

    chain: Chain | None


@dataclass(frozen=True, eq=False)
class FoundMoving:
    """The answer of :meth:`Detector.find_moving`."""

    chains: tuple[Chain, ...]


@dataclass(frozen=True, eq=False)
class ObliquePlaces:
    """The answer of :func:`~fluoromap.segmenter.places.oblique_places.place_obliquely` for a frame."""

    chains: tuple[Chain, ...]


@dataclass(frozen=True, slots=True)
class RunLag:
    """The answer of :func:`~fluoromap.segmenter.picture.lag.measure_lag`."""

    lag: float


@dataclass(frozen=True, slots=True)
class ExtraCatheter:
    """The answer of :meth:`Detector.shows_extra_catheter` for the mean image."""

    is_shown: bool


def segment_run(
    run: Run,
    catalogue: Catalogue,
    marks: Marks,
    context: Context,
    detector_of: Callable[[FieldMask], Detector],
    search_again: bool = False,
    search_moving: bool = False,
    shows_catheter: RunJudge | None = None,
    oblique: bool = False,
) -> Segmentation:
    """Segment a run: tracked chains of all frames, and diastolic chains.

    Chains at diastole come from the mean of the quiet frames round diastole. Marks replace the automatic chains of their
    frames, and the tracks of the run are followed again from the first marked frame. At diastole a mark counts as follows:

    - A mark in one of the averaged frames replaces the automatic chain of the same catheter or place.
    - A mark elsewhere, of a catheter that is missing at diastole, moves diastole to the quietest marked frame. The
      automatic chains of that frame are added.

    Parameters
    ----------
    run : Run
    catalogue : Catalogue
    marks : Marks
        Chains that were set by hand.
    context : Context
        For progress and cancellation.
    detector_of : callable
        The field mask of the run -> the detector to use.
    search_again : bool
        Whether to search for missing catheters with :meth:`Detector.find_again`.
    search_moving : bool
        Whether to search for catheters without a track with :meth:`Detector.find_moving`.
    shows_catheter : RunJudge, optional
        Decides about each track. Then a diastolic chain needs an accepted track. All are accepted by default.
    oblique : bool
        Whether the chains get the places of :func:`~fluoromap.segmenter.places.oblique_places.place_obliquely` in the end.
    """
    context.check()
    # Marks change the tracks, but not what the images show.
    recall = recall_for(run, catalogue, context)
    field = field_mask(recall(ExposedField, (), lambda: exposed_field(run.frames, run.pixels)), run.frames.shape)
    transform = LogTransform.of_run(run.pixels, field.mean_level)
    lag = recall(RunLag, (), lambda: RunLag(measure_lag(run.frames, field.inside, run.pixels))).lag
    frames = ShadowlessFrames(run.frames, lag, run.pixels.bits_stored) if lag else run.frames
    count = len(frames)

    def log_image(frame: int) -> Image:
        return field.fill(transform(frames[frame]))

    @functools.cache
    def mean_image(averaged: tuple[int, ...]) -> Image:
        total = np.zeros(frames.shape, np.float64)
        for index in averaged:
            total += frames[index].astype(np.float64)
        return field.fill(transform(total / len(averaged)))

    detections = recall(
        RunDetections, (), lambda: _detect(run, detector_of(field), log_image, mean_image, field, context)
    )
    motion, averaged = detections.motion, detections.averaged
    automatic = {
        index: entry.chains if entry.manual_needed is None else ()
        for index, entry in enumerate(detections.frames)
        if index in marks
    }
    context.progress(0.9)
    context.check()
    mean = detections.mean
    # A detector remembers the images before. A new one gives the same answers for recalled detections.
    detector = detector_of(field)
    mean_x = mean_image(averaged)
    catheters = len(catalogue.catheters)
    search = _chain_search(detector, log_image, context, recall) if search_again else None
    seed = mean if len(averaged) > 1 else None
    place = _oblique_placing(run, catalogue, log_image, recall) if oblique else None
    judge = None if shows_catheter is None else _judge(shows_catheter, log_image, recall, place)

    def tracked(found: Sequence[FrameChains]) -> tuple[FrameChains, ...]:
        entries = track_chains(found, run.frame_times_ms, catheters, search, seed, judge)
        if not search_moving:
            return entries
        hidden = _moving_search(detector, log_image, run.frame_times_ms, context, recall)

        def follow(found: Sequence[FrameChains], start: FrameChains) -> tuple[FrameChains, ...]:
            return track_chains(found, run.frame_times_ms, catheters, search, start, judge, marks_first=False)

        return add_hidden_catheters(found, entries, catalogue, run.px_per_mm, hidden, follow)

    entries = recall(RunTracks, (), lambda: RunTracks(tracked(detections.frames))).frames
    if marks:
        entries = tracked(_with_marks(entries, detections.frames, marks))
    entries = _mark_out_of_field(entries, field)
    context.progress(0.95)
    chains = mean.chains
    needs_track = shows_catheter is not None and count > 1
    if search_again:
        chains = _turned_as_tracks(mean_x, chains, detector, averaged, entries)
        if needs_track:
            # Else it would take the place of a catheter that the frames show.
            chains = _on_tracks(_assign_tracks(chains, averaged, entries), entries)
        chains = _add_missing_catheters(mean_x, chains, detector, averaged, entries, catheters)
    chains, averaged = _apply_marks(chains, averaged, entries, automatic, motion, run.px_per_mm)
    chains = _assign_tracks(chains, averaged, entries)
    if search_again:
        chains = _with_shapes_of_tracks(mean_x, chains, detector, averaged, entries)
    if needs_track:
        chains = _on_tracks(chains, entries)
    reason = None if chains else Reason.MANUAL_NEEDED
    if chains:
        extra = recall(
            ExtraCatheter,
            (detections.averaged, *chains),
            lambda: ExtraCatheter(detector.shows_extra_catheter(mean_x, chains)),
        )
        reason = Reason.EXTRA_CATHETER if extra.is_shown else None
    entries = tuple(replace(entry, chains=at_scale(entry.chains, run.px_per_mm)) for entry in entries)
    chains = at_scale(chains, run.px_per_mm)
    if place is not None:
        entries = tuple(replace(entry, chains=place(entry.frame, entry.chains)) for entry in entries)
        chains = place_obliquely(mean_x, chains, catalogue, run.px_per_mm)
    gain = rest_gain(frames, field.inside, run.pixels.bits_stored)

    def widened(x: Image, chains: tuple[Chain, ...]) -> tuple[Chain, ...]:
        return with_unexplained_profile(x, chains, catalogue, run.px_per_mm, gain)

    if gain:
        entries = tuple(
            replace(entry, chains=widened(log_image(entry.frame), entry.chains)) if entry.chains else entry
            for entry in entries
        )
        chains = widened(mean_x, chains)
    entries, chains = with_jitter(entries, chains, run.px_per_mm)
    entries = with_lag(entries, lag, run.px_per_mm)
    entries = tuple(replace(entry, chains=with_shape(entry.chains, catalogue, run.px_per_mm)) for entry in entries)
    chains = with_shape(chains, catalogue, run.px_per_mm)
    diastole = FrameChains(averaged[len(averaged) // 2], chains, reason)
    context.progress(1.0)
    return Segmentation(
        frames=entries,
        diastole=diastole,
        diastole_frames=averaged,
        motion=motion,
        frame_times_ms=run.frame_times_ms,
        r_wave_frames=run.r_wave_frames,
    )


def _oblique_placing(
    run: Run, catalogue: Catalogue, log_image: Callable[[int], Image], recall: Recall[ObliquePlaces]
) -> PlaceObliquely:
    def place(frame: int, chains: tuple[Chain, ...]) -> tuple[Chain, ...]:
        def compute() -> ObliquePlaces:
            return ObliquePlaces(place_obliquely(log_image(frame), chains, catalogue, run.px_per_mm))

        return recall(ObliquePlaces, (frame, *chains), compute).chains if chains else ()

    return place


def _with_marks(tracked: Sequence[FrameChains], detections: Sequence[FrameChains], marks: Marks) -> list[FrameChains]:
    """Return the chains from which the tracks of a marked run are followed.

    The tracks of the run without marks have found their catheters in most frames, so that few are searched again. Detections that
    are on none of these tracks may belong to the marked catheter.
    """
    found = []
    for entry, detected in zip(tracked, detections, strict=True):
        if entry.frame in marks:
            by_hand = tuple(replace(chain, manual=True) for chain in marks[entry.frame])
            found.append(FrameChains(entry.frame, by_hand))
            continue
        chains = tuple(chain.on_track(-1) for chain in entry.chains)
        others = tuple(chain for chain in detected.chains if not overlaps(chain, chains))
        reason = detected.manual_needed if others or not chains else None
        found.append(FrameChains(entry.frame, (*chains, *others), reason))
    return found


def _detect(
    run: Run,
    detector: Detector,
    log_image: Callable[[int], Image],
    mean_image: Callable[[tuple[int, ...]], Image],
    field: FieldMask,
    context: Context,
) -> RunDetections:
    """Find the chains of every frame, and of their diastolic mean."""
    count = len(run.frames)
    meter = MotionMeter((log_image(index) for index in evenly_spaced_frames(count)), field.inside)
    motion = np.zeros(count)
    found: list[FrameChains] = []
    images: deque[tuple[int, Image]] = deque(maxlen=3)
    for index in range(count):
        context.check()
        images += [
            (after, log_image(after)) for after in range(images[-1][0] + 1 if images else 0, min(index + 2, count))
        ]
        (x,) = (image for number, image in images if number == index)
        motion[index] = meter(x)
        found.append(detector.find_chains(x, index, _beside(index, images, run.frame_times_ms)))
        context.progress(0.8 * (index + 1) / count)
    if count > 1:
        motion[0] = motion[1]
    context.check()
    quiet = diastolic_frames(motion, run.frame_times_ms, run.r_wave_frames)
    averaged = still_frames(quiet, found, run.frame_times_ms, run.px_per_mm)
    middle = averaged[len(averaged) // 2]
    mean = detector.find_chains(mean_image(averaged), middle)
    return RunDetections(
        tuple(found), motion, averaged, mean if mean.manual_needed is None else FrameChains(middle, ())
    )


def _beside(frame: int, images: Iterable[tuple[int, Image]], frame_times_ms: Array) -> list[Image]:
    """Return the images of other frames that are near in time.

    Catheters have hardly moved between them.
    """
    return [
        image
        for number, image in images
        if number != frame and abs(frame_times_ms[number] - frame_times_ms[frame]) <= _SAME_MOMENT_MS
    ]


def _judge(
    shows_catheter: RunJudge, log_image: Callable[[int], Image], recall: Recall[Any], place: PlaceObliquely | None
) -> TrackJudge:
    """Return the judge of a run's tracks.

    Openings hide the middles of a long row's rings, so that it is judged again at its final places where it is not clear.
    """

    def judge(chains: Mapping[int, Chain]) -> Verdict:
        verdict = shows_catheter(chains, log_image, recall)
        is_row = max(len(chain.electrodes) for chain in chains.values()) >= MANY_ELECTRODES
        if place is None or not is_row or (verdict.is_catheter and verdict.log_odds >= _SURE_ROW):
            return verdict
        placed = {frame: place(frame, (chain,))[0] for frame, chain in chains.items()}
        again = shows_catheter(placed, log_image, recall)
        return max(verdict, again, key=lambda one: (one.is_catheter, one.log_odds))

    return judge


def _chain_search(
    detector: Detector, log_image: Callable[[int], Image], context: Context, recall: Recall[FoundAgain]
) -> ChainSearch:
    kept: tuple[int, Image] | None = None

    def search(
        frame: int,
        chain: Chain,
        shift: Array,
        reach_px: float,
        taken: Sequence[Chain],
        same_shape: bool = False,
        confirmed: bool = False,
    ) -> Chain | None:
        def find() -> FoundAgain:
            nonlocal kept
            if kept is None or kept[0] != frame:
                context.check()
                kept = frame, log_image(frame)
            return FoundAgain(detector.find_again(kept[1], chain, shift, reach_px, taken, frame, same_shape, confirmed))

        # A frame may be a number of NumPy, and ``taken`` may grow later.
        return recall(
            FoundAgain, (int(frame), chain, shift, reach_px, same_shape, confirmed, len(taken), *taken), find
        ).chain

    return search


def _moving_search(
    detector: Detector,
    log_image: Callable[[int], Image],
    frame_times_ms: Array,
    context: Context,
    recall: Recall[FoundMoving],
) -> MovingSearch:
    """Return the search for moving catheters round a frame.

    It finds none where few frames are near in time.
    """

    def search(frame: int) -> tuple[Chain, ...]:
        context.check()
        near = np.flatnonzero(np.abs(frame_times_ms - frame_times_ms[frame]) <= WINDOW_MS)
        if len(near) < _LEAST_MOVED:
            return ()

        def find() -> FoundMoving:
            images = [log_image(int(index)) for index in near]
            return FoundMoving(detector.find_moving(images, frame_times_ms[near], frame - int(near[0]), frame))

        return recall(FoundMoving, (frame,), find).chains

    return search


def _turned_as_tracks(
    x: Image,
    chains: tuple[Chain, ...],
    detector: Detector,
    averaged: tuple[int, ...],
    entries: Sequence[FrameChains],
) -> tuple[Chain, ...]:
    """Return the mean image's chains in the direction of their tracks.

    All frames of a track decide about its direction. A turned chain is fitted again, because a tip is longer than a ring.
    """
    tracked = [other for frame in averaged for other in entries[frame].chains]
    as_tracks = []
    for chain in chains:
        other_way = reverse(chain)
        as_it_is, turned = (
            min((sum(chain_distance(one, other)) for other in tracked), default=np.inf) for one in (chain, other_way)
        )
        if turned <= _SAME_TRACK_PX < as_it_is:
            beside = [other for other in chains if other is not chain]
            again = detector.find_again(x, other_way, np.zeros(2), _SAME_TRACK_PX / 2, beside)
            chain = other_way if again is None else replace(again, tip_odds=other_way.tip_odds)
        as_tracks.append(chain)
    return tuple(as_tracks)


def _add_missing_catheters(
    x: Image,
    found: tuple[Chain, ...],
    detector: Detector,
    averaged: tuple[int, ...],
    entries: Sequence[FrameChains],
    catheters: int,
) -> tuple[Chain, ...]:
    """Add catheters that only single frames show to the mean image's chains."""
    middle = averaged[len(averaged) // 2]
    chains = list(found)
    on_tracks = {chain.track for chain in _assign_tracks(chains, averaged, entries)}
    for frame in sorted(averaged, key=lambda frame: abs(frame - middle)):
        for known in entries[frame].chains:
            if known.track not in on_tracks and len(chains) < catheters and not known.manual:
                on_tracks.add(known.track)
                carried = detector.find_again(x, known, np.zeros(2), _SAME_TRACK_PX / 2, chains)
                chains += [] if carried is None else [carried.on_track(-1)]
    return tuple(chains)


def _with_shapes_of_tracks(
    x: Image,
    chains: tuple[Chain, ...],
    detector: Detector,
    averaged: tuple[int, ...],
    entries: Sequence[FrameChains],
) -> tuple[Chain, ...]:
    """Return the mean image's chains in the shape of their tracks."""
    middle = averaged[len(averaged) // 2]
    agreed = []
    for chain in chains:
        track = {entry.frame: other for entry in entries for other in entry.chains if other.track == chain.track}
        beside = [other for other in chains if other is not chain]

        def search(shape: Chain, shift: Array, reach_px: float, beside: list[Chain] = beside) -> Chain | None:
            return detector.find_again(x, shape, shift, reach_px, beside, same_shape=True)

        agreed.append(with_shape_of_track(chain, middle, track, search))
    return tuple(agreed)


def _mark_out_of_field(entries: Sequence[FrameChains], field: FieldMask) -> tuple[FrameChains, ...]:
    """Replace TRACK_INTERRUPTED by OUT_OF_FIELD where catheters left the field.

    Every missing catheter must have been at the edge of the field when it was found last.
    """
    seen: dict[int, list[tuple[int, Chain]]] = {}
    for entry in entries:
        for chain in entry.chains:
            seen.setdefault(chain.track, []).append((entry.frame, chain))
    usual = {track: known for track, known in seen.items() if len(known) > len(entries) / 2}
    told = []
    for entry in entries:
        if entry.manual_needed is Reason.TRACK_INTERRUPTED:
            here = {chain.track for chain in entry.chains}
            last = [
                min(known, key=lambda one: abs(one[0] - entry.frame))[1]
                for track, known in usual.items()
                if track not in here
            ]
            if last and all(_at_edge(chain, field) for chain in last):
                entry = replace(entry, manual_needed=Reason.OUT_OF_FIELD)
        told.append(entry)
    return tuple(told)


def _at_edge(chain: Chain, field: FieldMask) -> bool:
    rows, columns = field.candidates.shape
    for u, v in np.rint(chain.pixels_uv).astype(np.int64):
        left, top = max(u - _EDGE_PX, 0), max(v - _EDGE_PX, 0)
        if u + _EDGE_PX >= columns or v + _EDGE_PX >= rows or min(u, v) < _EDGE_PX:
            return True
        if not field.candidates[top : v + _EDGE_PX + 1, left : u + _EDGE_PX + 1].all():
            return True
    return False


def _is_same_catheter(one: Chain, other: Chain, px_per_mm: float) -> bool:
    """Return whether two chains of one moment share a certain name or the place."""
    if any(probability > 0.99 and other.probability(name) > 0.99 for name, probability in one.kinds):
        return True
    return sum(chain_distance(one, other)) <= _SAME_PLACE_MM * px_per_mm


def _merge_marks(marked: Sequence[Chain], automatic: Sequence[Chain], px_per_mm: float) -> tuple[Chain, ...]:
    return (
        *marked,
        *(chain for chain in automatic if not any(_is_same_catheter(chain, mark, px_per_mm) for mark in marked)),
    )


def _apply_marks(
    chains: tuple[Chain, ...],
    averaged: tuple[int, ...],
    entries: Sequence[FrameChains],
    automatic: dict[int, tuple[Chain, ...]],
    motion: Array,
    px_per_mm: float,
) -> tuple[tuple[Chain, ...], tuple[int, ...]]:
    if not automatic:
        return chains, averaged
    middle = averaged[len(averaged) // 2]
    within = [frame for frame in automatic if frame in averaged]
    if within:
        nearest = min(within, key=lambda frame: abs(frame - middle))
        return _merge_marks(entries[nearest].chains, chains, px_per_mm), averaged
    tracks = {chain.track for chain in _assign_tracks(chains, averaged, entries)}
    lacking = [frame for frame in automatic if any(chain.track not in tracks for chain in entries[frame].chains)]
    if not lacking:
        return chains, averaged
    quietest = min(lacking, key=lambda frame: float(motion[frame]))
    return _merge_marks(entries[quietest].chains, automatic[quietest], px_per_mm), (quietest,)


def _on_tracks(chains: Sequence[Chain], entries: Sequence[FrameChains]) -> tuple[Chain, ...]:
    """Return the chains that were set by hand or belong to a track."""
    tracks = {chain.track for entry in entries for chain in entry.chains}
    return tuple(chain for chain in chains if chain.manual or chain.track in tracks)


def _assign_tracks(
    chains: Sequence[Chain], averaged: Sequence[int], entries: Sequence[FrameChains]
) -> tuple[Chain, ...]:
    """Give each diastolic chain the track number of the averaged frames.

    The number is that of the chains at the same place, where most of the averaged frames that show the track show it there. Chains
    that cannot be the same catheter do not count, unless a user set one of them.
    """
    taken: set[int] = {chain.track for chain in chains if chain.track >= 0}
    fresh = 1 + max((chain.track for entry in entries for chain in entry.chains), default=-1)
    numbered: list[Chain] = []
    for chain in chains:
        if chain.track < 0:
            votes: dict[int, int] = {}
            for frame in averaged:
                near = [
                    (sum(chain_distance(chain, other)), other.track)
                    for other in entries[frame].chains
                    if other.track not in taken and (chain.manual or other.manual or kind_overlap(chain, other) > 0)
                ]
                if near and min(near)[0] <= _SAME_TRACK_PX:
                    votes[min(near)[1]] = votes.get(min(near)[1], 0) + 1
            number = max(votes, key=lambda track: votes[track], default=-1)
            shown = sum(any(other.track == number for other in entries[frame].chains) for frame in averaged)
            if number < 0 or 2 * votes[number] < shown:
                number, fresh = fresh, fresh + 1
            taken.add(number)
            chain = chain.on_track(number)
        numbered.append(chain)
    return tuple(numbered)
