"""Things in fluoroscopy that are no electrodes. They carry no labels.

A network trained without them answers to everything that is dark and small: they decide the result.
"""

from __future__ import annotations

from collections.abc import Callable

from numpy.random import Generator

from fluoromap.training import contrast_medium, implants, lines, probes
from fluoromap.training.drawing import Canvas

_Kinds = tuple[tuple[Callable[[Generator, Canvas, float], None], float], ...]


def draw_distractors(random: Generator, canvas: Canvas, px_per_mm: float, crowd: float = 1.0) -> None:
    """Draw a random choice of distractors.

    ``crowd`` is the scene's size over that for which the numbers below hold. A larger scene has more things, so that they lie as
    densely. A line grows with the scene, so fewer of them keep the density.
    """
    for kinds, more in ((_LONG, crowd), (_COMPACT, crowd * crowd)):
        for draw, mean in kinds:
            for _ in range(int(random.poisson(mean * more))):
                draw(random, canvas, px_per_mm)


_LONG: _Kinds = (
    (lines.draw_cable, 1.0),
    (lines.draw_parallel_cables, 0.12),
    (lines.draw_guide_wire, 0.8),
    (lines.draw_sheath, 0.3),
    (lines.draw_plain_catheter, 0.25),
    (lines.draw_ecg_electrode, 0.22),
    (probes.draw_segmented_shaft, 0.07),
    (probes.draw_temperature_probe, 0.1),
    (probes.draw_sensor_row, 0.1),
)
_COMPACT: _Kinds = (
    (implants.draw_coil, 0.12),
    (contrast_medium.draw_vessels, 0.33),
    (contrast_medium.draw_drained_tube, 0.22),
    (contrast_medium.draw_residue, 0.17),
    (contrast_medium.draw_tubing, 0.15),
    (probes.draw_echo_probe, 0.1),
    (implants.draw_clip, 0.45),
    (implants.draw_blob, 0.65),
    (implants.draw_sternal_wire, 0.2),
    (implants.draw_valve_ring, 0.12),
    (implants.draw_device, 0.06),
)
"""Mean number of each kind in a scene."""
