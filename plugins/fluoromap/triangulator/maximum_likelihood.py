"""Maximum-likelihood triangulation: least reprojection error, the shift between the two runs taken out."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import BaseModel

from fluoromap.catheters import Catalogue
from fluoromap.contracts import Array, Context, MatchedSite, Triangulation
from fluoromap.geometry import Camera
from fluoromap.matching.two_view import signed_epipolar_px, triangulate_linear
from fluoromap.triangulator.two_view import Cameras, TwoViewPixels, locate_study
from fluoromap.triangulator.uncertainty import UncertaintyParams

_STEPS = 8
_SETTLED_MM = 1e-12


class MaximumLikelihood:
    """Triangulator ``maximum-likelihood``.

    The two runs of a site are taken one after the other, so breathing (or the gantry) displaces the whole heart between
    them. First that displacement is estimated from the site's own electrodes, see :func:`common_shift_mm`; then every
    electrode is put where its reprojection error, weighted by its pixel covariances, is least.
    """

    name: ClassVar[str] = "maximum-likelihood"
    version: ClassVar[str] = "1"
    Params: ClassVar[type[BaseModel]] = UncertaintyParams

    def __init__(self, params: UncertaintyParams) -> None:
        self._params = params

    def triangulate(self, sites: tuple[MatchedSite, ...], catalogue: Catalogue, context: Context) -> Triangulation:
        prior = self._params.shift_covariance_mm2()
        catheter_sd_mm = self._params.catheter_sd_mm()

        def estimate_shift(cameras: Cameras, pixels: TwoViewPixels) -> Array:
            return common_shift_mm(cameras, pixels, prior, catheter_sd_mm)

        return locate_study(sites, catalogue, context, self._params, _locate, estimate_shift)


def _locate(cameras: Cameras, pixels: TwoViewPixels) -> Array:
    return triangulate_maximum_likelihood(*cameras, *pixels.pixels, *pixels.covariances)


def triangulate_maximum_likelihood(
    camera_a: Camera,
    camera_b: Camera,
    pixels_a: Array,
    pixels_b: Array,
    covariances_a_px2: Array,
    covariances_b_px2: Array,
) -> Array:
    """Points of least reprojection error by Gauss-Newton, all at once, from the linear solution on.

    Parameters
    ----------
    pixels_a, pixels_b : ndarray, shape (N, 2)
        The same N electrodes (u, v) in the two views.
    covariances_a_px2, covariances_b_px2 : ndarray, shape (N, 2, 2)
        Of those pixels.

    Returns
    -------
    ndarray, shape (N, 3)
        World, mm.
    """
    points = triangulate_linear(camera_a, camera_b, pixels_a, pixels_b)
    views = (
        (camera_a, pixels_a, np.linalg.inv(covariances_a_px2)),
        (camera_b, pixels_b, np.linalg.inv(covariances_b_px2)),
    )
    for _ in range(_STEPS):
        normal = np.zeros((len(points), 3, 3))
        gradient = np.zeros((len(points), 3))
        for camera, pixels, weight in views:
            jacobian = camera.jacobian(points)
            weighted = np.einsum("nki,nkl->nil", jacobian, weight)
            normal += weighted @ jacobian
            gradient += np.einsum("nil,nl->ni", weighted, pixels - camera.project(points))
        step = np.linalg.solve(normal, gradient[..., None])[..., 0]
        points = points + step
        if len(step) == 0 or np.abs(step).max() < _SETTLED_MM:
            break
    return points


def common_shift_mm(cameras: Cameras, pixels: TwoViewPixels, prior_mm2: Array, catheter_sd_mm: float) -> Array:
    """Displacement that all electrodes of a site share in each run, from their epipolar distances.

    Two views show a common displacement only in the direction across the epipolar lines, and there only its difference
    between the runs. That is estimated with all electrodes together (the mean signed epipolar distance, in essence) as a
    ridge regression whose prior is how far breathing and the isocentre displace the heart in each run; what the views
    can't show stays at the prior's mean, 0.

    Parameters
    ----------
    prior_mm2 : ndarray, shape (6, 6)
        Covariance of the displacement in view a, then in view b.
    catheter_sd_mm : float
        How far one catheter's place varies from beat to beat: catheters count once each, not once an electrode.

    Returns
    -------
    ndarray, shape (2, 3)
        World, mm: the electrodes stand displaced by this in view a, in view b.
    """
    distances = signed_epipolar_px(*cameras, *pixels.pixels)
    step_mm = 0.5
    slopes = np.empty((len(distances), 6))
    for k in range(6):
        shift = np.zeros((2, 3))
        shift[k // 3, k % 3] = step_mm
        plus, minus = (
            signed_epipolar_px(
                cameras[0].translated(sign * shift[0]), cameras[1].translated(sign * shift[1]), *pixels.pixels
            )
            for sign in (1, -1)
        )
        slopes[:, k] = (minus - plus) / (2 * step_mm)
    # Translating a camera moves the line the other way, as seen from the points: hence minus before plus above.
    catheters = np.array([catheter for catheter, _ in pixels.labels])
    same = catheters[:, None] == catheters[None, :]
    noise = np.diag(sum(np.trace(c, axis1=1, axis2=2) / 2 for c in pixels.covariances))
    noise = noise + same * 2 * (catheter_sd_mm * cameras[1].px_per_mm) ** 2
    spread = slopes @ prior_mm2 @ slopes.T + noise
    shift_mm: Array = (prior_mm2 @ slopes.T @ np.linalg.solve(spread, distances)).reshape(2, 3)
    return shift_mm
