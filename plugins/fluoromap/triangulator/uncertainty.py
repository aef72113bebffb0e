"""Assumptions about the errors of electrodes in two views."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, Field

from fluoromap.contracts import Array
from fluoromap.triangulator.gantry_kinds import GANTRY_KINDS, second_moment


class UncertaintyParams(BaseModel, extra="forbid"):
    """Assumptions of both triangulators about all errors except pixel noise; standard deviations."""

    gantry_angle_sd_deg: float = Field(
        0.5, ge=0, le=10, description="Error of each gantry angle in the header, degrees."
    )
    isocentre_sd_mm: float = Field(0.5, ge=0, le=20, description="Error of the isocentre's place in each view, mm.")
    magnification_sd: float = Field(
        0.003, ge=0, le=0.2, description="Relative error of the source-to-detector distance in each view."
    )
    respiration_head_feet_sd_mm: float = Field(
        4.0, ge=0, le=30, description="Breathing position of the heart in each run along the patient's long axis, mm."
    )
    respiration_other_sd_mm: float = Field(
        1.0, ge=0, le=30, description="Breathing position of the heart in each run along the other two axes, mm."
    )
    respiration_drift_sd_mm: float = Field(
        0.2, ge=0, le=30, description="Breathing within a run, about the run's mean, along the patient's long axis, mm."
    )
    beat_sd_mm: float = Field(
        0.25, ge=0, le=10, description="Variation of a catheter tip's place from beat to beat, mm an axis."
    )
    bend_sd_mm: float = Field(
        0.025,
        ge=0,
        le=10,
        description="Displacement of an electrode beyond the share that follows its catheter's tip, mm an axis.",
    )
    tip_centre_sd_mm: float = Field(
        0.2,
        ge=0,
        le=5,
        description="Distance along the shaft from the middle of a tip of 4 mm or less to its centre in the image, mm.",
    )
    beat_amplitude_sd: float = Field(
        0.04, ge=0, le=1, description="Variation of the motion's amplitude from beat to beat, as a share of it."
    )
    beat_timing_sd: float = Field(
        0.017, ge=0, le=0.5, description="Variation of the contraction's moment from beat to beat, in cycles."
    )
    phase_pairing_sd: float = Field(
        0.015, ge=0, le=0.5, description="Error of bringing the two runs to the same cardiac phase, in cycles."
    )
    spacing_limit_mm: float = Field(
        1.5, gt=0, le=20, description="Electrode spacings farther than this from the catalogue's are reported, mm."
    )

    def respiration_covariance_mm2(self) -> Array:
        """Return the covariance (3, 3) of the heart's breathing position in one run."""
        other, head = self.respiration_other_sd_mm**2, self.respiration_head_feet_sd_mm**2
        return np.diag([other, other, head])

    def gantry_covariance(self) -> Array:
        """Return the covariance (14, 14) of the gantry's errors, independent in each view.

        See :func:`~fluoromap.triangulator.error_sources.gantry_effect_px`. It describes the usual gantry. Other gantries are
        better or worse, see ``GANTRY_KINDS``.
        """
        angle, offset = np.radians(self.gantry_angle_sd_deg) ** 2, self.isocentre_sd_mm**2
        views = np.tile(np.repeat([angle, offset], 3), 2)
        return np.diag([*views, *np.full(2, self.magnification_sd**2)])

    def header_covariance(self) -> Array:
        """Return the covariance (14, 14) of errors that no data show.

        It is the second moment over all kinds of gantry.
        """
        return second_moment(*self.header_moments())

    def header_moments(self) -> tuple[Array, Array]:
        """Return the shares (k,) and second moments (k, 14, 14) of all kinds of gantry."""
        shares = np.array([kind.share for kind in GANTRY_KINDS])
        moments = np.array([self.gantry_covariance() * kind.multiples**2 for kind in GANTRY_KINDS])
        return shares, moments

    def scaled(self, breathing: float, beats: float) -> UncertaintyParams:
        """Return the parameters with these multiples of breathing and beats."""
        return self.model_copy(
            update={
                "respiration_head_feet_sd_mm": breathing * self.respiration_head_feet_sd_mm,
                "respiration_other_sd_mm": breathing * self.respiration_other_sd_mm,
                "respiration_drift_sd_mm": breathing * self.respiration_drift_sd_mm,
                "beat_sd_mm": beats * self.beat_sd_mm,
            }
        )
