"""The last steps of a run: final places and ellipses of all its electrodes.

They come after tracking, so that nothing is searched or judged with them. Each step is a source of
:mod:`~fluoromap.segmenter.places.ellipse`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from fluoromap.catheters import Catalogue
from fluoromap.contracts import BoolArray, Chain, FrameChains, FrameSource, Run
from fluoromap.segmenter.picture.log_image import Image
from fluoromap.segmenter.places.ellipse import at_scale, rest_gain, with_jitter, with_lag, with_shape
from fluoromap.segmenter.places.oblique_places import place_obliquely
from fluoromap.segmenter.places.refinement import with_unexplained_profile
from fluoromap.segmenter.runs.recalled_searches import PlaceObliquely


@dataclass(frozen=True, slots=True, eq=False)
class FinalPictures:
    """The pictures of a run in which electrodes have their final places.

    frames : those that were searched. inside : (rows, columns) the exposed field. lag : of the run, see
    :func:`~fluoromap.segmenter.picture.lag.measure_lag`. log_image : frame -> its log image. mean : log image of the mean at
    diastole.
    """

    frames: FrameSource
    inside: BoolArray
    lag: float
    log_image: Callable[[int], Image]
    mean: Image


def with_final_ellipses(
    run: Run,
    catalogue: Catalogue,
    entries: Sequence[FrameChains],
    diastole: tuple[Chain, ...],
    pictures: FinalPictures,
    place: PlaceObliquely | None,
) -> tuple[tuple[FrameChains, ...], tuple[Chain, ...]]:
    """Return a run's chains and those at diastole with their final ellipses.

    Parameters
    ----------
    run : Run
    catalogue : Catalogue
    entries : sequence of FrameChains
        Tracked chains, one entry a frame.
    diastole : tuple of Chain
        The chains of the mean, with the numbers of their tracks.
    pictures : FinalPictures
    place : PlaceObliquely, optional
        Gives the chains of a frame their places as oblique cylinders. None where they keep their places.
    """
    scale = run.px_per_mm

    def each_frame(entries: Sequence[FrameChains], step: PlaceObliquely) -> tuple[FrameChains, ...]:
        return tuple(replace(entry, chains=step(entry.frame, entry.chains)) for entry in entries)

    frames, chains = each_frame(entries, lambda _, found: at_scale(found, scale)), at_scale(diastole, scale)
    if place is not None:
        frames = each_frame(frames, place)
        chains = place_obliquely(pictures.mean, chains, catalogue, scale)
    gain = rest_gain(pictures.frames, pictures.inside, run.pixels.bits_stored)
    if gain:

        def with_rests(frame: int, found: tuple[Chain, ...]) -> tuple[Chain, ...]:
            if not found:
                return found
            return with_unexplained_profile(pictures.log_image(frame), found, catalogue, scale, gain)

        frames = each_frame(frames, with_rests)
        chains = with_unexplained_profile(pictures.mean, chains, catalogue, scale, gain)
    frames, chains = with_jitter(frames, chains, scale)
    frames = with_lag(frames, pictures.lag, scale)
    frames = each_frame(frames, lambda _, found: with_shape(found, catalogue, scale))
    return frames, with_shape(chains, catalogue, scale)
