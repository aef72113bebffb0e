"""The place of the map on a fluoroscopy frame: its shift into the world, and the pixel of the mapping tip.

The map's coordinates count from the reference catheter. The shift is the position of that catheter in the frame, in mm from
the isocentre: world = map + shift.
"""

from __future__ import annotations

import numpy as np

from fluoromap.contracts import Array, LocatedSite, NamedChain
from fluoromap.geometry import Camera


def map_shift_mm(
    site: LocatedSite, camera: Camera, reference: NamedChain | None, tracked_mm: Array | None, mean_mm: Array
) -> Array:
    """Return the shift (3,) of the map in one frame.

    It is the first of these that exists:

    1. The position of the reference catheter in this frame by the track of this view.
    2. The diastolic position of the reference catheter at this site. It is moved across the rays to the place where this
       frame shows the catheter, because the heart breathes between the two runs of a site. In a frame that does not show
       the catheter, the diastolic position is used unmoved.
    3. The mean position of the reference catheter over the sites.

    Parameters
    ----------
    site : LocatedSite
    camera : Camera
        Camera of the frame's view.
    reference : NamedChain or None
        The reference catheter in this frame; None where the frame does not show it.
    tracked_mm : (3,) or None
        Position of the reference catheter in this frame by the track of the view.
    mean_mm : (3,)
        Mean position of the reference catheter over the sites.
    """
    if tracked_mm is not None:
        return tracked_mm
    if site.reference_mm is None:
        return mean_mm
    if reference is None:
        return site.reference_mm
    shift: Array = site.reference_mm + displacement_mm(site, camera, reference)
    return shift


def displacement_mm(site: LocatedSite, camera: Camera, chain: NamedChain) -> Array:
    """Return the displacement (3,) of a catheter from diastole to one frame.

    A single view does not show displacements along its rays. This is the smallest displacement that explains the frame, and
    0 when diastole and frame have no electrode of the catheter in common.
    """
    common = [
        (point.position_mm, pixel)
        for electrode, pixel in zip(chain.electrodes, chain.pixels_uv, strict=True)
        if (point := site.point(chain.catheter, electrode)) is not None
    ]
    if not common:
        return np.zeros(3)
    positions, pixels = (np.array(column) for column in zip(*common, strict=True))
    off_px = (pixels - camera.project(positions)).mean(axis=0)
    displacement: Array = np.linalg.pinv(camera.jacobian(positions.mean(axis=0))) @ off_px
    return displacement


def tip_pixel(
    site: LocatedSite, camera: Camera, mapping: str, chain: NamedChain | None, shift_mm: Array
) -> Array | None:
    """Return the pixel (2,) of the mapping tip in one frame.

    It is the pixel of electrode 1 where the frame shows it, otherwise the projection of the tip's position on the map. None
    when the site has no located tip either.

    Parameters
    ----------
    mapping : str
        Name of the mapping catheter.
    chain : NamedChain or None
        The mapping catheter in this frame; None where the frame does not show it.
    shift_mm : (3,)
        As :func:`map_shift_mm` gives it.
    """
    if chain is not None and 1 in chain.electrodes:
        pixel: Array = chain.pixels_uv[chain.electrodes.index(1)]
        return pixel
    tip = site.point(mapping, 1)
    if tip is None:
        return None
    return camera.project(tip.position_mm if tip.relative_mm is None else tip.relative_mm + shift_mm)
