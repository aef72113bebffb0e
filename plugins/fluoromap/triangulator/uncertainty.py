"""What can be wrong about a point from two views, and its covariance."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, Field

from fluoromap.contracts import Array
from fluoromap.geometry import Camera


class UncertaintyParams(BaseModel, extra="forbid"):
    """What both triangulators assume about everything but the pixels; standard deviations."""

    gantry_angle_sd_deg: float = Field(
        0.5, ge=0, le=10, description="Error of each gantry angle in the header, degrees."
    )
    isocentre_sd_mm: float = Field(0.5, ge=0, le=20, description="Error of the isocentre's place in each view, mm.")
    respiration_head_feet_sd_mm: float = Field(
        4.0, ge=0, le=30, description="Breathing position of the heart in each run along the patient's long axis, mm."
    )
    respiration_other_sd_mm: float = Field(
        1.0, ge=0, le=30, description="Breathing position of the heart in each run along the other two axes, mm."
    )
    beat_sd_mm: float = Field(
        0.25, ge=0, le=10, description="Variation of a catheter's place from beat to beat, mm an axis."
    )
    amplitude_sd: float = Field(
        0.04, ge=0, le=1, description="Variation of the motion's amplitude from beat to beat, as a share of it."
    )
    amplitude_mm: float = Field(
        3.0, ge=0, le=30, description="Distance of a catheter at diastole from the middle of its motion, mm."
    )
    cycle_beat_sd_mm: float = Field(
        0.45, ge=0, le=10, description="As beat_sd_mm, for moments when the heart moves: mismatch of phase included."
    )
    spacing_limit_mm: float = Field(
        1.5, gt=0, le=20, description="Electrode spacings farther than this from the catalogue's are told, mm."
    )

    def catheter_sd_mm(self) -> float:
        """Of one catheter's diastolic place in one run, an axis."""
        return float(np.hypot(self.beat_sd_mm, self.amplitude_sd * self.amplitude_mm / np.sqrt(3.0)))

    def shift_covariance_mm2(self) -> Array:
        """Covariance (6, 6) of the displacement that all catheters share in view a, then in view b."""
        other, head = self.respiration_other_sd_mm**2, self.respiration_head_feet_sd_mm**2
        one_view = np.array([other, other, head]) + self.isocentre_sd_mm**2
        return np.diag(np.tile(one_view, 2))


def joint_covariance(
    cameras: tuple[Camera, Camera],
    points_world_mm: Array,
    pixel_covariances_px2: tuple[Array, Array],
    catheters: tuple[str, ...],
    params: UncertaintyParams,
    catheter_sd_mm: float,
    shift_estimated: bool,
) -> Array:
    """Covariance between all coordinates of all points of a site, to first order.

    Every point is a weighted least-squares answer from four pixel coordinates. Pixel noise is independent from
    electrode to electrode. Beat-to-beat variation displaces each catheter as a whole in each run. Breathing displaces
    all catheters alike in each run, and errors of the gantry angles turn them alike about the isocentre: both are carried
    along with their correlation, so that they cancel, as far as they do, in positions relative to the reference catheter.

    Parameters
    ----------
    points_world_mm : ndarray, shape (N, 3)
    pixel_covariances_px2 : pair of ndarray, shape (N, 2, 2)
        Of each point in view a and b.
    catheters : tuple of str
        Of each point.
    catheter_sd_mm : float
        Variation of a catheter's place in one run, an axis.
    shift_estimated : bool
        The answer took account of the shift between the views, see :func:`common_shift_mm`.

    Returns
    -------
    ndarray, shape (N, 3, N, 3)
        mm^2.
    """
    n = len(points_world_mm)
    names = sorted(set(catheters))
    unknowns = 3 * n + (6 if shift_estimated else 0)
    shift = params.shift_covariance_mm2()
    normal = np.zeros((unknowns, unknowns))
    if shift_estimated:
        normal[3 * n :, 3 * n :] = np.linalg.inv(shift + 1e-9 * np.eye(6))
    width = 6 + 6 + 6 * len(names)
    coupling = np.zeros((unknowns, width))
    for view, camera in enumerate(cameras):
        jacobian = camera.jacobian(points_world_mm)
        weight = np.linalg.inv(pixel_covariances_px2[view])
        information = np.einsum("nki,nkl,nlj->nij", jacobian, weight, jacobian)
        for i in range(n):
            at, own = slice(3 * i, 3 * i + 3), information[i]
            turned = own @ -_cross(points_world_mm[i])
            c = 12 + 6 * names.index(catheters[i]) + 3 * view
            normal[at, at] += own
            coupling[at, 3 * view : 3 * view + 3] += own
            coupling[at, 6 + 3 * view : 9 + 3 * view] += turned
            coupling[at, c : c + 3] += own
            if shift_estimated:
                common = slice(3 * n + 3 * view, 3 * n + 3 * view + 3)
                normal[at, common] += own
                normal[common, at] += own
                normal[common, common] += own
                coupling[common, 6 + 3 * view : 9 + 3 * view] += turned
                coupling[common, c : c + 3] += own
    estimated = np.linalg.inv(normal)
    angle = np.full(6, np.radians(params.gantry_angle_sd_deg) ** 2)
    beats = np.full(6 * len(names), catheter_sd_mm**2)
    # An estimated shift is an unknown with a prior; otherwise it is an error that nobody looked at.
    considered = np.concatenate([np.zeros(6) if shift_estimated else np.diag(shift), angle, beats])
    gain = (estimated @ coupling) * np.sqrt(considered)
    covariance = (estimated + gain @ gain.T)[: 3 * n, : 3 * n]
    symmetric: Array = ((covariance + covariance.T) / 2).reshape(n, 3, n, 3)
    return symmetric


def relative_covariance_mm2(joint_mm2: Array, index: int, reference: list[int]) -> Array:
    """Covariance (3, 3) of point ``index`` minus the mean of the points ``reference``, from the joint one (N, 3, N, 3)."""
    weights = np.zeros(len(joint_mm2))
    weights[index] += 1.0
    weights[reference] -= 1.0 / len(reference)
    covariance: Array = np.einsum("i,iajb,j->ab", weights, joint_mm2, weights)
    # The reference's own electrodes can come out with nearly nothing; a covariance stays positive definite.
    return covariance + 1e-9 * np.eye(3)


def _cross(vector: Array) -> Array:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
