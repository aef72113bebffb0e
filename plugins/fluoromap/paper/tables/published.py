"""Numbers printed in the paper, mm.

P. Fallavollita, 3D/2D Registration of Mapping Catheter Images for Arrhythmia Interventional Assistance, IJCSI.
"""

from __future__ import annotations

from fluoromap.paper.tables.depth_figures import DepthFigures
from fluoromap.paper.tables.helix import HelixView

DEPTH_STEPS_MM = (0, 1, 2, 3, 4, 5)
"""Start values dz of the tables."""
IMAGES = (3, 4, 5, 6)
"""Lengths of the sequences of Table 1; Table 2 has the first and the last."""

# A row for each dz; in it (mean, min, max, 3D RMS) for 3, 4, 5 and 6 images.
_TABLE_1: dict[HelixView, tuple[tuple[tuple[float, float, float, float], ...], ...]] = {
    "LAT": (
        ((2.188, .148, 3.840, 3.976), (1.752, .094, 3.837, 4.527), (1.463, .003, 3.951, 5.152), (1.150, .015, 3.373, 5.324)),
        ((1.491, .043, 2.877, 2.763), (1.272, .039, 2.876, 3.122), (1.247, .101, 2.998, 3.802), (1.230, .011, 2.413, 4.411)),
        ((1.254, .005, 1.913, 2.048), (1.223, .098, 2.628, 2.813), (1.363, .006, 3.052, 4.095), (1.522, .021, 3.327, 5.645)),
        ((1.190, .059, 2.860, 2.341), (1.418, .008, 3.643, 3.873), (1.730, .009, 4.072, 5.787), (2.074, .012, 4.351, 8.097)),
        ((1.698, .014, 3.862, 3.390), (2.197, .007, 4.659, 5.567), (2.568, .064, 5.091, 8.037), (3.021, .465, 5.375, 10.979)),
        ((2.668, .978, 4.862, 4.714), (3.173, .969, 5.673, 7.476), (3.544, .812, 6.111, 10.492), (4.004, 1.424, 6.399, 14.028)),
    ),
    "AP": (
        ((1.033, .096, 1.917, 1.911), (.976, .003, 2.067, 2.613), (.929, .007, 2.128, 3.204), (.869, .004, 2.160, 3.674)),
        ((.578, .005, .929, .983), (.651, .006, 1.080, 1.541), (.657, .010, 1.138, 2.004), (.641, .002, 1.165, 2.398)),
        ((.915, .060, 1.830, 1.742), (.977, .002, 1.996, 2.592), (1.045, .003, 2.070, 3.443), (1.114, .001, 2.109, 4.314)),
        ((1.890, 1.050, 2.794, 3.142), (1.942, .896, 2.954, 4.458), (2.004, .842, 3.023, 5.815), (2.074, .825, 3.057, 7.220)),
        ((2.866, 2.040, 3.758, 4.635), (2.913, 1.885, 3.912, 6.471), (2.974, 1.832, 3.976, 8.363), (3.042, 1.820, 4.006, 10.314)),
        ((3.842, 3.030, 4.723, 6.154), (3.885, 2.873, 4.872, 8.528), (3.944, 2.822, 4.930, 10.965), (4.011, 2.814, 4.955, 13.468)),
    ),
}  # fmt: skip

LATERAL_OFFSETS_MM = (0.0, 1.44, 1.95, 1.52, 0.63, -0.49)
"""Common depth of all points of images 1 to 6, fitted to the lateral half of Table 1. It is not in the paper, which mentions
errors of up to 2 mm added to the coordinates without giving them."""

# No row of Table 2 is known here, only the ratio of its 3D RMS to its mean at dz = 5 for (3, 6) images.
_TABLE_2_RATIOS = {"LAT": {3: 1.587, 6: 3.357}, "PA": {3: 1.591, 6: 3.340}}


def table_1(view: HelixView, dz_mm: int, images: int) -> DepthFigures:
    """Return the paper's Table 1 for a view, a start value and a number of images."""
    return DepthFigures(*_TABLE_1[view][DEPTH_STEPS_MM.index(dz_mm)][IMAGES.index(images)])


def table_2_rms_over_mean(view: str, dz_mm: int, images: int) -> float | None:
    """Return 3D RMS over mean of the paper's Table 2.

    The result is None where it is not known.
    """
    return _TABLE_2_RATIOS[view].get(images) if dz_mm == 5 else None
