"""Reason codes for lower grades and refusals: the closed list, each with its sentence."""

from enum import StrEnum


class Reason(StrEnum):
    """A reason code as it appears in points, tracks and maps.

    Its ``sentence`` explains the event and the remedy to an electrophysiologist.
    """

    NO_ELECTRODES = "no_electrodes"
    MANUAL_NEEDED = "manual_needed"
    CATHETER_NOT_FOUND = "catheter_not_found"
    IDENTITY_BY_MOTION = "identity_by_motion"
    IDENTITY_UNCERTAIN = "identity_uncertain"
    NO_REFERENCE = "no_reference"
    NO_RESTING_CATHETER = "no_resting_catheter"
    NO_ACTIVATION_TIME = "no_activation_time"
    ONE_VIEW_ONLY = "one_view_only"
    VIEWS_PARALLEL = "views_parallel"
    GANTRY_TURNED = "gantry_turned"
    NO_GEOMETRY = "no_geometry"
    NO_A_PRIORI = "no_a_priori"
    PAIRING_FAILED = "pairing_failed"
    SPACING_MISMATCH = "spacing_mismatch"
    CATALOGUE_CONTRADICTED = "catalogue_contradicted"
    TABLE_MOVED = "table_moved"
    DEPTH_UNOBSERVABLE = "depth_unobservable"
    DEPTH_ASSUMED = "depth_assumed"
    TRACK_INTERRUPTED = "track_interrupted"
    PHASE_UNKNOWN = "phase_unknown"
    LAT_OUTLIER = "lat_outlier"
    PAIRED_BY_ORDER = "paired_by_order"
    ORDER_UNKNOWN = "order_unknown"
    TOO_FEW_SITES = "too_few_sites"
    SITES_COPLANAR = "sites_coplanar"
    MARK_NOT_USED = "mark_not_used"
    EXTRA_CATHETER = "extra_catheter"
    OUT_OF_FIELD = "out_of_field"
    PRIOR_GATE = "prior_gate"
    MOTION_FROM_OTHERS = "motion_from_others"
    IRREGULAR_RHYTHM = "irregular_rhythm"
    VIEW_MIRRORED = "view_mirrored"
    GEOMETRY_DOUBTFUL = "geometry_doubtful"
    SITES_COINCIDE = "sites_coincide"
    TIMES_EQUAL = "times_equal"
    OUTSIDE_WINDOW = "outside_window"
    PLUGIN_FAILED = "plugin_failed"

    @property
    def sentence(self) -> str:
        """Explanation for the user."""
        return _SENTENCES[self]


_SENTENCES: dict[Reason, str] = {
    Reason.NO_ELECTRODES: "No electrodes were found in this run; mark them by hand on one frame or check the contrast.",
    Reason.MANUAL_NEEDED: "The electrodes could not be distinguished from the background; mark them by hand on one frame.",
    Reason.CATHETER_NOT_FOUND: "This catheter was not found in one of the views; mark it by hand on one frame.",
    Reason.IDENTITY_BY_MOTION: "The reference catheter was chosen among look-alikes because it moves least between the sites.",
    Reason.IDENTITY_UNCERTAIN: "Two catheters, or the two ends of this one, could be exchanged; mark it by hand on one frame.",
    Reason.NO_REFERENCE: "No reference catheter was located here; its mean over the other sites was used, else the isocentre.",
    Reason.NO_RESTING_CATHETER: "No catheter rests in this study; a table that moved between the two views would not be noticed.",
    Reason.NO_ACTIVATION_TIME: "This site has no activation time; send one with the activation-time table.",
    Reason.ONE_VIEW_ONLY: "This site has only one run; a second view at least 30 degrees away is needed.",
    Reason.VIEWS_PARALLEL: "The two views are less than 20 degrees apart, which gives no depth; record a view farther away.",
    Reason.GANTRY_TURNED: "The gantry turned during one of the two runs; record this view with a gantry at rest.",
    Reason.NO_GEOMETRY: "The gantry geometry is incomplete; complete the instance's missing values.",
    Reason.NO_A_PRIORI: "No biplane position is known here; a single view gives no depth.",
    Reason.PAIRING_FAILED: "The catheters of the two views do not belong together; check which runs are paired at this site.",
    Reason.SPACING_MISMATCH: "The electrode spacing found differs from the catalogue's; check the catheter's description.",
    Reason.CATALOGUE_CONTRADICTED: "The image contradicts this catheter's description; check its electrode spacings and its tip.",
    Reason.TABLE_MOVED: "The table moved, or may have moved, between the two views; repeat one of them.",
    Reason.DEPTH_UNOBSERVABLE: "One view does not give the depth of this catheter to a useful accuracy.",
    Reason.DEPTH_ASSUMED: "The depth along the ray comes from the solver's start value, not from the image.",
    Reason.TRACK_INTERRUPTED: "The catheter was not seen in this frame.",
    Reason.PHASE_UNKNOWN: "No cardiac cycle could be recognised in this run; the quietest frames were used.",
    Reason.LAT_OUTLIER: "The activation time does not agree with its neighbours; check the annotation.",
    Reason.PAIRED_BY_ORDER: "The site's runs are a guess: pairs in order of time took the table's rows in order; confirm them.",
    Reason.ORDER_UNKNOWN: "The headers do not say which of these runs came first; check which runs are paired at this site.",
    Reason.TOO_FEW_SITES: "Fewer than four sites could be located; a chamber surface needs at least four.",
    Reason.SITES_COPLANAR: "All located sites lie in one plane; a chamber surface needs sites on several walls.",
    Reason.MARK_NOT_USED: "Electrodes set by hand contradict the other view or the other frames and were not used; check them.",
    Reason.EXTRA_CATHETER: "More catheters were found than the study describes; add the missing one to its catheters.",
    Reason.OUT_OF_FIELD: "This catheter leaves the field of view in some frames; those frames hold no position.",
    Reason.PRIOR_GATE: "The image contradicts the expected motion of this catheter; its depth is the expected one.",
    Reason.MOTION_FROM_OTHERS: "This site has no cardiac cycle of its own in two views; the motion of the other sites was used.",
    Reason.IRREGULAR_RHYTHM: "The beats of this run differ in length; positions away from diastole are less certain.",
    Reason.VIEW_MIRRORED: "The two views fit only when one is mirrored; check the image orientation of both runs.",
    Reason.GEOMETRY_DOUBTFUL: "The two views disagree more than the gantry tolerance allows; check the geometry of both runs.",
    Reason.SITES_COINCIDE: "All located sites lie in one place; a chamber surface needs sites on several walls.",
    Reason.TIMES_EQUAL: "All activation times are equal; there is no order of activation to show.",
    Reason.OUTSIDE_WINDOW: "This activation time lies outside the window of interest and was brought into it by whole cycles.",
    Reason.PLUGIN_FAILED: "The plugin for this stage failed; the job's stage shows its message.",
}

AT_BEST_C = frozenset({
    Reason.IDENTITY_UNCERTAIN, Reason.EXTRA_CATHETER, Reason.TABLE_MOVED, Reason.GEOMETRY_DOUBTFUL, Reason.SPACING_MISMATCH,
    Reason.VIEW_MIRRORED, Reason.PAIRING_FAILED, Reason.NO_RESTING_CATHETER,
})  # fmt: skip
"""Doubts about which electrode this is or where its views are: no covariance contains them, so the grade is at best C."""
AT_BEST_B = frozenset({Reason.CATALOGUE_CONTRADICTED, Reason.MARK_NOT_USED})
"""Doubts that may displace an electrode by a part of its size: the grade is at best B."""
