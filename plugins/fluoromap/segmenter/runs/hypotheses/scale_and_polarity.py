"""Scale and polarity of pictures whose header says nothing of them: those at which the catalogue explains the pictures best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from fluoromap.catheters import Catalogue
from fluoromap.contracts import FrameChains, PixelFacts, Run
from fluoromap.segmenter.electrodes.network.weights import SHIPPED, Trained, read_weights
from fluoromap.segmenter.frames.electrode_detector import electrode_chains
from fluoromap.segmenter.picture.field_mask import FieldMask, evenly_spaced_frames, find_field
from fluoromap.segmenter.picture.log_image import Image, LogTransform

SCALES_PX_PER_MM = 2.3, 2.7, 3.1, 3.6, 4.1, 4.7, 5.4, 6.2, 7.1, 8.2, 9.4, 10.8
"""Scales of fluoroscopy at the isocentre, each 15 % above the one before: of 512 to 1024 pixels, and of printed figures."""

_WIDEST_FIELD_MM = 350.0
"""Longer side of the picture at the isocentre: the largest flat detectors have 400 mm, and a C-arm enlarges at least 1.15 times."""
_FRAMES = 3
_LEAST_ELECTRODES = 3.0
_NEARLY_ALL = 0.75
_MORE = 1.5
"""How many times as many electrodes an inverted picture has to show: bright letters and gaps look like some."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """How well the catalogue explains pictures at one scale and polarity.

    px_per_mm : at the isocentre. monochrome1 : whether high values are dark. electrodes : expected number of the catalogue's
    electrodes in a frame, the sum of their probabilities. sure : whether every frame that was tried shows a clear chain.
    """

    px_per_mm: float
    monochrome1: bool
    electrodes: float
    sure: bool


def find_scale(
    run: Run,
    catalogue: Catalogue,
    scales_px_per_mm: Sequence[float] = SCALES_PX_PER_MM,
    trained: Trained | None = None,
) -> Explanation | None:
    """Return the scale and the polarity at which the catalogue explains a run best.

    ``run.px_per_mm`` is not used. The polarity is the header's, unless the other one explains clearly more. A larger scale
    explains the same pictures by stronger foreshortening, so the smallest scale that explains nearly as much as the best is
    returned. It is right to about 20 %: enough to find electrodes and to show them, not to locate them. ``trained`` : the
    shipped network by default.

    The work is bounded. A scale at which the picture would be wider than any detector is not tried. A scale is left as soon as one
    frame shows no clear chain at it. The other polarity is not tried where it cannot explain clearly more.

    Returns
    -------
    Explanation or None
        None where no scale explains three frames.
    """
    possible = [scale for scale in scales_px_per_mm if max(run.frames.shape) <= _WIDEST_FIELD_MM * scale]

    def explain(pixels: PixelFacts) -> Explanation | None:
        return _smallest_of_the_best(_explanations(run, pixels, catalogue, possible, trained, True))

    header = explain(run.pixels)
    most = float(sum(catheter.electrodes for catheter in catalogue.catheters))
    if header is not None and most <= _MORE * header.electrodes:
        return header
    other = explain(_inverted(run.pixels))
    if header is None or other is None:
        return header or other
    return other if _explains_more(other, header) else header


def is_inverted(run: Run, catalogue: Catalogue, trained: Trained | None = None) -> bool:
    """Return whether the catalogue explains the run only with its grey levels inverted.

    ``trained`` : the shipped network by default.
    """
    inverted = _explanations(run, _inverted(run.pixels), catalogue, (run.px_per_mm,), trained)
    of_inverted = _smallest_of_the_best(inverted)
    if of_inverted is None:
        return False
    (as_it_says,) = _explanations(run, run.pixels, catalogue, (run.px_per_mm,), trained)
    return _explains_more(of_inverted, as_it_says)


def promising_scales(
    run: Run, catalogue: Catalogue, scales_px_per_mm: Sequence[float], least: float, trained: Trained | None = None
) -> tuple[float, ...]:
    """Return those scales that explain enough of a run.

    It is at least ``least`` times what the run's own scale explains. A few frames of the run are searched: too few to know
    at which scale the whole run shows more. Where its own scale does not show a clear chain in each of them, another one has to.
    ``trained`` : the shipped network by default.
    """
    own, *others = _explanations(run, run.pixels, catalogue, (run.px_per_mm, *scales_px_per_mm), trained)
    return tuple(one.px_per_mm for one in others if one.electrodes >= least * own.electrodes and (own.sure or one.sure))


def frame_electrodes(run: Run, catalogue: Catalogue, frame: int, trained: Trained | None = None) -> float:
    """Return how many electrodes of a catalogue a frame shows.

    It is the sum of their probabilities. ``trained`` : the shipped network by default.
    """
    field = find_field(run.frames, run.pixels)
    image = field.fill(LogTransform.of_run(run.pixels, field.mean_level)(run.frames[frame]))
    network = read_weights(SHIPPED) if trained is None else trained
    alone = len(run.frames) == 1
    return _explained([image], field, run.pixels, catalogue, run.px_per_mm, network, alone).electrodes


def _inverted(pixels: PixelFacts) -> PixelFacts:
    return replace(pixels, monochrome1=not pixels.monochrome1)


def _explains_more(inverted: Explanation, as_it_says: Explanation) -> bool:
    return inverted.electrodes > _MORE * as_it_says.electrodes


def _smallest_of_the_best(tried: Sequence[Explanation]) -> Explanation | None:
    """Return the smallest of the scales that explain nearly as much as the best."""
    possible = [one for one in tried if one.sure and one.electrodes >= _LEAST_ELECTRODES]
    if not possible:
        return None
    best = max(possible, key=lambda one: one.electrodes)
    return min(
        (one for one in possible if one.electrodes >= _NEARLY_ALL * best.electrodes),
        key=lambda one: one.px_per_mm,
    )


def _explanations(
    run: Run,
    pixels: PixelFacts,
    catalogue: Catalogue,
    scales_px_per_mm: Sequence[float],
    trained: Trained | None,
    until_unsure: bool = False,
) -> list[Explanation]:
    """Explain a few frames of a run at each scale.

    ``until_unsure`` : a scale is left at the first frame without a clear chain.
    """
    field = find_field(run.frames, pixels)
    transform = LogTransform.of_run(pixels, field.mean_level)
    frames = list(evenly_spaced_frames(len(run.frames)))
    images = [field.fill(transform(run.frames[frame])) for frame in frames[:: max(1, len(frames) // _FRAMES)][:_FRAMES]]
    network = read_weights(SHIPPED) if trained is None else trained
    alone = len(images) == 1
    return [
        _explained(images, field, pixels, catalogue, scale, network, alone, until_unsure) for scale in scales_px_per_mm
    ]


def _explained(
    images: Sequence[Image],
    field: FieldMask,
    pixels: PixelFacts,
    catalogue: Catalogue,
    px_per_mm: float,
    trained: Trained,
    alone: bool,
    until_unsure: bool = False,
) -> Explanation:
    detector = electrode_chains(catalogue, field, pixels, px_per_mm, trained, alone)
    entries: list[FrameChains] = []
    for number, x in enumerate(images):
        entries.append(detector.find_chains(x, number))
        if until_unsure and entries[-1].manual_needed is not None:
            break
    return Explanation(
        px_per_mm,
        pixels.monochrome1,
        sum(float(chain.scores.sum()) for entry in entries for chain in entry.chains) / len(entries),
        all(entry.manual_needed is None for entry in entries),
    )
