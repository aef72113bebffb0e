"""Sources of error of electrodes in two views, and their effect on the pixels.

Points (N, 3) may also be (..., N, 3): many moments with the same electrodes. Every returned array then has the same leading
axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fluoromap.catheters import Catalogue, follows_tip
from fluoromap.contracts import Array
from fluoromap.geometry import Camera
from fluoromap.triangulator.two_view_pixels import Cameras
from fluoromap.triangulator.uncertainty import UncertaintyParams

Share = Literal["pixels", "angles", "source_distances", "phase_mismatch", "breathing"]
"""Entry of the :class:`~fluoromap.contracts.ErrorBudget` to which an error source belongs."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of the electrodes at one moment of the cycle.

    displaced_mm : (..., N, 3) displacement from diastole. velocity_mm : (..., N, 3), mm a cycle.
    """

    displaced_mm: Array
    velocity_mm: Array


@dataclass(frozen=True, eq=False)
class ErrorSource:
    """One cause of error with k unknown parameters.

    effect_px : (..., 4 N, k) change of the pixels with one unit of each parameter, electrode by electrode: u, v in view a,
    then in view b. covariance : (k, k) of the parameters. shares : (k,) the error budget's entry of each parameter.
    """

    effect_px: Array
    covariance: Array
    shares: tuple[Share, ...]

    def pixels_px2(self) -> Array:
        """Return the covariance (..., 4 N, 4 N) of the pixels from this source."""
        covariance: Array = self.effect_px @ self.covariance @ np.swapaxes(self.effect_px, -1, -2)
        return covariance


def jacobians(cameras: Cameras, points_world_mm: Array) -> Array:
    """Return d(u, v)/d(X, Y, Z) in view a and b at points (..., N, 3), shape (..., N, 2, 2, 3)."""
    return np.stack([camera.jacobian(points_world_mm) for camera in cameras], axis=-3)


def effect_px(jacobian: Array, displacement_a: Array, displacement_b: Array) -> Array:
    """Return the effect (..., 4 N, k) on the pixels of parameters that displace the electrodes.

    Parameters
    ----------
    jacobian : ndarray, shape (..., N, 2, 2, 3)
        See :func:`jacobians`.
    displacement_a, displacement_b : ndarray, shape (..., N, 3, k) or (3, k)
        Displacement as each view sees it, world, mm, for one unit of each parameter.
    """
    *moments, n = jacobian.shape[:-3]
    parts = [jacobian[..., view, :, :] @ d for view, d in enumerate((displacement_a, displacement_b))]
    effect: Array = np.stack(parts, axis=-3).reshape(*moments, 4 * n, -1)
    return effect


def gantry_effect_px(cameras: Cameras, jacobian: Array, points_world_mm: Array) -> Array:
    """Return the effect (4 N, 14) of the gantry's errors on the pixels.

    The first 12 parameters are the rotation vector about the isocentre (radians) and the offset (mm) of view a, then of
    view b. They displace the electrodes as that view sees them: ``X' = R X + t``. The last two are the relative errors of
    the source-to-detector distance in view a and b.
    """
    own = [_turned_and_shifted(points_world_mm - camera.isocentre_world_mm) for camera in cameras]
    none = np.zeros_like(own[0])
    across = [_across(camera, points_world_mm) for camera in cameras]
    no_scale = np.zeros_like(across[0])
    in_a = np.concatenate([own[0], none, across[0], no_scale], axis=-1)
    in_b = np.concatenate([none, own[1], no_scale, across[1]], axis=-1)
    return effect_px(jacobian, in_a, in_b)


def _turned_and_shifted(points_mm: Array) -> Array:
    """Return the displacement (..., N, 3, 6) by a rotation and an offset.

    The first three columns are a small rotation vector about the origin.
    """
    x, y, z = np.moveaxis(points_mm, -1, 0)
    zero = np.zeros_like(x)
    cross_product = np.moveaxis(np.array([[zero, z, -y], [-z, zero, x], [y, -x, zero]]), (0, 1), (-2, -1))
    return np.concatenate([cross_product, np.broadcast_to(np.eye(3), cross_product.shape)], axis=-1)


def breathing_effect_px(jacobian: Array) -> Array:
    """Return the effect (4 N, 3) of half the breathing displacement (mm) between the two runs.

    Positions are those at the middle of the two runs' breathing positions: no data show the rest position.
    """
    return effect_px(jacobian, np.eye(3), -np.eye(3))


def visible_breathing(cameras: Cameras, points_world_mm: Array, params: UncertaintyParams) -> ErrorSource:
    """Return the part of the breathing displacement that two views can show, one parameter.

    That part is perpendicular to the plane of the two central rays. Within the plane, breathing between the runs looks like
    another position of the heart. Perspective distinguishes them, but by less than the gantry's errors.
    """
    across = np.cross(cameras[0].axis_world, cameras[1].axis_world)
    across /= np.linalg.norm(across)
    variance = float(across @ params.respiration_covariance_mm2() @ across) / 2
    effect = breathing_effect_px(jacobians(cameras, points_world_mm)) @ across[:, None]
    return ErrorSource(effect, np.array([[variance]]), ("breathing",))


def error_sources(
    cameras: Cameras,
    points_world_mm: Array,
    labels: Sequence[tuple[str, int]],
    catalogue: Catalogue,
    params: UncertaintyParams,
    gantry_covariance: Array,
    motion: Motion | None,
) -> tuple[ErrorSource, ...]:
    """Return all error sources at one moment of a site, except pixel noise.

    Breathing displaces all catheters alike in each run, and errors of the gantry turn and shift them alike. The sources
    keep these correlations, so that such errors partly cancel in positions relative to the reference catheter.
    Beat-to-beat variation displaces each catheter as a whole in each run. It also strengthens or weakens the motion of all
    catheters and shifts it in time; these two matter where the heart moves.

    Parameters
    ----------
    points_world_mm : ndarray, shape (..., N, 3)
    labels : sequence of (catheter, electrode)
        Labels of the N points.
    gantry_covariance : ndarray, shape (14, 14)
        From :meth:`UncertaintyParams.gantry_covariance` or from self-calibration.
    motion : Motion or None
        None where the heart rests.
    """
    return (
        *common_sources(cameras, points_world_mm, labels, catalogue, params, gantry_covariance, motion),
        bend_source(jacobians(cameras, points_world_mm), params),
    )


def common_sources(
    cameras: Cameras,
    points_world_mm: Array,
    labels: Sequence[tuple[str, int]],
    catalogue: Catalogue,
    params: UncertaintyParams,
    gantry_covariance: Array,
    motion: Motion | None,
) -> tuple[ErrorSource, ...]:
    """Return the error sources that displace several electrodes alike.

    These are the sources of :func:`error_sources` without the electrodes' own bends.
    """
    return (
        *study_sources(cameras, points_world_mm, labels, catalogue, params, gantry_covariance),
        *site_sources(cameras, points_world_mm, labels, catalogue, params, motion),
    )


def study_sources(
    cameras: Cameras,
    points_world_mm: Array,
    labels: Sequence[tuple[str, int]],
    catalogue: Catalogue,
    params: UncertaintyParams,
    gantry_covariance: Array,
) -> tuple[ErrorSource, ...]:
    """Return the sources whose size a study shows: gantry, breathing and beats.

    Their effects on the pixels depend neither on ``params`` nor on ``gantry_covariance``.
    """
    jacobian = jacobians(cameras, points_world_mm)
    gantry: tuple[Share, ...] = (*(*("angles",) * 3, *("source_distances",) * 3) * 2, *("source_distances",) * 2)
    return (
        ErrorSource(gantry_effect_px(cameras, jacobian, points_world_mm), gantry_covariance, gantry),
        *breathing_sources(jacobian, params),
        *beat_sources(jacobian, points_world_mm, labels, catalogue, params),
    )


def study_covariance(params: UncertaintyParams, gantry_covariance: Array, catheters: int) -> Array:
    """Return the covariance (k, k) of the parameters of all :func:`study_sources`, in their order."""
    k = len(gantry_covariance)
    variances = np.zeros(k + 5 + 6 * catheters)
    variances[k + 3 : k + 5] = params.respiration_drift_sd_mm**2
    variances[k + 5 :] = params.beat_sd_mm**2
    covariance: Array = np.diag(variances)
    covariance[:k, :k] = gantry_covariance
    covariance[k : k + 3, k : k + 3] = params.respiration_covariance_mm2() / 2
    return covariance


def site_sources(
    cameras: Cameras,
    points_world_mm: Array,
    labels: Sequence[tuple[str, int]],
    catalogue: Catalogue,
    params: UncertaintyParams,
    motion: Motion | None,
) -> tuple[ErrorSource, ...]:
    """Return the common sources whose size no study shows.

    These are the centres of the tips and the motion of the heart.
    """
    jacobian = jacobians(cameras, points_world_mm)
    sources = []
    for name in sorted({catheter for catheter, _ in labels}):
        tip = _tip_along_shaft(points_world_mm, labels, name)
        if tip is not None:
            # Both views show the same centre, so that no epipolar distance reveals it.
            effect = effect_px(jacobian, tip, tip)
            sd_mm = catalogue[name].tip_centre_sd_mm(params.tip_centre_sd_mm)
            sources.append(ErrorSource(effect, np.array([[sd_mm**2]]), ("pixels",)))
    if motion is not None:
        displaced, velocity = motion.displaced_mm[..., None], motion.velocity_mm[..., None]
        sources.append(_both_views(jacobian, displaced, displaced, params.beat_amplitude_sd, "phase_mismatch"))
        # The phase is that of view a; view b contributes its frame nearest to that phase.
        timing = np.diag(np.square([params.beat_timing_sd, np.hypot(params.beat_timing_sd, params.phase_pairing_sd)]))
        none = np.zeros_like(velocity)
        late = effect_px(
            jacobian, np.concatenate([velocity, none], axis=-1), np.concatenate([none, velocity], axis=-1)
        )  # fmt: skip
        sources.append(ErrorSource(late, timing, ("phase_mismatch",) * 2))
    return tuple(sources)


def breathing_sources(jacobian: Array, params: UncertaintyParams) -> tuple[ErrorSource, ErrorSource]:
    """Return breathing between the two runs and within each run."""
    head_feet = np.array([[0.0], [0.0], [1.0]])
    return (
        ErrorSource(breathing_effect_px(jacobian), params.respiration_covariance_mm2() / 2, ("breathing",) * 3),
        _both_views(jacobian, head_feet, head_feet, params.respiration_drift_sd_mm, "breathing"),
    )


def beat_sources(
    jacobian: Array,
    points_world_mm: Array,
    labels: Sequence[tuple[str, int]],
    catalogue: Catalogue,
    params: UncertaintyParams,
) -> list[ErrorSource]:
    """Return the variation of each catheter's place from beat to beat."""
    follows = follows_tip(points_world_mm, labels, catalogue)
    return [
        _both_views(jacobian, own, own, params.beat_sd_mm, "phase_mismatch")
        for name in sorted({catheter for catheter, _ in labels})
        for own in [follows * np.array([catheter == name for catheter, _ in labels])[:, None, None]]
    ]


def bend_source(jacobian: Array, params: UncertaintyParams) -> ErrorSource:
    """Return the displacement of each electrode beyond the share that follows its catheter's tip."""
    n = jacobian.shape[-4]
    each = np.eye(3 * n).reshape(n, 3, 3 * n)
    return _both_views(jacobian, each, each, params.bend_sd_mm, "phase_mismatch")


def bend_covariances_px2(jacobian: Array, params: UncertaintyParams) -> tuple[Array, Array]:
    """Return the pixels' covariances (..., N, 2, 2) in view a and b from :func:`bend_source`."""
    of_view = params.bend_sd_mm**2 * (jacobian @ np.swapaxes(jacobian, -1, -2))
    return of_view[..., 0, :, :], of_view[..., 1, :, :]


def _tip_along_shaft(points_world_mm: Array, labels: Sequence[tuple[str, int]], catheter: str) -> Array | None:
    """Return the displacement (..., N, 3, 1) of a tip along its shaft.

    None where electrode 1 or 2 is missing.
    """
    if (catheter, 1) not in labels or (catheter, 2) not in labels:
        return None
    tip, second = labels.index((catheter, 1)), labels.index((catheter, 2))
    along = points_world_mm[..., tip, :] - points_world_mm[..., second, :]
    displaced = np.zeros((*points_world_mm.shape, 1))
    displaced[..., tip, :, 0] = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    return displaced


def _both_views(jacobian: Array, in_a: Array, in_b: Array, sd: float, share: Share) -> ErrorSource:
    """Return a source whose parameters vary independently in each view."""
    k = in_a.shape[-1]
    *moments, n = jacobian.shape[:-3]
    effect = np.zeros((*moments, n, 2, 2, 2, k))
    for view, displacement in enumerate((in_a, in_b)):
        effect[..., view, :, view, :] = jacobian[..., view, :, :] @ displacement
    effect = effect.reshape(*moments, 4 * n, 2 * k)
    return ErrorSource(effect, sd**2 * np.eye(2 * k), (share,) * (2 * k))


def _across(camera: Camera, points_world_mm: Array) -> Array:
    """Return the part of points across the central ray, (..., N, 3, 1): a wrong magnification stretches it."""
    along, points = camera.axis_world, points_world_mm - camera.isocentre_world_mm
    across: Array = (points - (points @ along)[..., None] * along)[..., None]
    return across


def pixel_noise_px2(covariances_px2: tuple[Array, Array]) -> Array:
    """Return the pixels' covariances, (..., N, 2, 2) in view a and b, as one matrix (..., 4 N, 4 N)."""
    *moments, n = covariances_px2[0].shape[:-2]
    noise = np.zeros((*moments, n, 2, 2, n, 2, 2))
    for row in range(n):
        for view, covariance in enumerate(covariances_px2):
            noise[..., row, view, :, row, view, :] = covariance[..., row, :, :]
    return noise.reshape(*moments, 4 * n, 4 * n)


def relative_covariances_mm2(joint_mm2: Array, reference: list[int]) -> Array:
    """Return the covariances (N, 3, 3) of all points relative to the reference catheter's mean.

    Parameters
    ----------
    joint_mm2 : ndarray, shape (N, 3, N, 3)
        Joint covariance of all points.
    reference : list of int
        The reference catheter's points.
    """
    n = len(joint_mm2)
    weights = np.eye(n)
    weights[:, reference] -= 1.0 / len(reference)
    left = (weights @ joint_mm2.reshape(n, -1)).reshape(n, 3, n, 3)
    covariances: Array = np.einsum("iajb,ij->iab", left, weights)
    # The variance of the reference's own electrodes can be nearly 0; this keeps the covariances positive definite.
    return covariances + 1e-9 * np.eye(3)
