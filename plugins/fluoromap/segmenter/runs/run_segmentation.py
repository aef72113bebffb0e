"""Segmentation of a run: field, chains of every frame, tracks, diastole."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Context, FrameChains, Marks, Run, Segmentation
from fluoromap.diastole import diastolic_frames
from fluoromap.reasons import Reason
from fluoromap.segmenter.frames.detector import Detector
from fluoromap.segmenter.picture.field_mask import (
    ExposedField,
    FieldMask,
    evenly_spaced_frames,
    exposed_field,
    field_mask,
)
from fluoromap.segmenter.picture.lag import measure_lag
from fluoromap.segmenter.picture.log_image import Image, LogTransform
from fluoromap.segmenter.picture.motion_meter import MotionMeter
from fluoromap.segmenter.picture.shadowless_frames import ShadowlessFrames
from fluoromap.segmenter.recall import recall_for
from fluoromap.segmenter.runs.diastole import (
    add_missing_catheters,
    apply_marks,
    assign_tracks,
    on_tracks,
    turned_as_tracks,
    with_shapes_of_tracks,
)
from fluoromap.segmenter.runs.final_ellipses import FinalPictures, with_final_ellipses
from fluoromap.segmenter.runs.out_of_field import mark_out_of_field
from fluoromap.segmenter.runs.partial_results import (
    ExtraCatheter,
    RunDetections,
    RunLag,
    RunTracks,
)
from fluoromap.segmenter.runs.recalled_searches import (
    RunJudge,
    chain_search,
    moving_search,
    oblique_placing,
    track_judge,
)
from fluoromap.segmenter.shape.chain_comparison import overlaps
from fluoromap.segmenter.tracks.hidden_catheters import add_hidden_catheters
from fluoromap.segmenter.tracks.still_frames import still_frames
from fluoromap.segmenter.tracks.tracking import track_chains

_SAME_MOMENT_MS = 40.0


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
    search = chain_search(detector, log_image, context, recall) if search_again else None
    seed = mean if len(averaged) > 1 else None
    place = oblique_placing(run, catalogue, log_image, recall) if oblique else None
    judge = None if shows_catheter is None else track_judge(shows_catheter, log_image, recall, place)

    def tracked(found: Sequence[FrameChains]) -> tuple[FrameChains, ...]:
        entries = track_chains(found, run.frame_times_ms, catheters, search, seed, judge)
        if not search_moving:
            return entries
        hidden = moving_search(detector, log_image, run.frame_times_ms, context, recall)

        def follow(found: Sequence[FrameChains], start: FrameChains) -> tuple[FrameChains, ...]:
            return track_chains(found, run.frame_times_ms, catheters, search, start, judge, marks_first=False)

        return add_hidden_catheters(found, entries, catalogue, run.px_per_mm, hidden, follow)

    entries = recall(RunTracks, (), lambda: RunTracks(tracked(detections.frames))).frames
    if marks:
        entries = tracked(_with_marks(entries, detections.frames, marks))
    entries = mark_out_of_field(entries, field)
    context.progress(0.95)
    chains = mean.chains
    needs_track = shows_catheter is not None and count > 1
    if search_again:
        chains = turned_as_tracks(mean_x, chains, detector, averaged, entries)
        if needs_track:
            # Else it would take the place of a catheter that the frames show.
            chains = on_tracks(assign_tracks(chains, averaged, entries), entries)
        chains = add_missing_catheters(mean_x, chains, detector, averaged, entries, catheters)
    chains, averaged = apply_marks(chains, averaged, entries, automatic, motion, run.px_per_mm)
    chains = assign_tracks(chains, averaged, entries)
    if search_again:
        chains = with_shapes_of_tracks(mean_x, chains, detector, averaged, entries)
    if needs_track:
        chains = on_tracks(chains, entries)
    reason = None if chains else Reason.MANUAL_NEEDED
    if chains:
        extra = recall(
            ExtraCatheter,
            (detections.averaged, *chains),
            lambda: ExtraCatheter(detector.shows_extra_catheter(mean_x, chains)),
        )
        reason = Reason.EXTRA_CATHETER if extra.is_shown else None
    entries, chains = with_final_ellipses(
        run, catalogue, entries, chains, FinalPictures(frames, field.inside, lag, log_image, mean_x), place
    )
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
