"""Anatomy of one heart: chamber and catheters in the chest, and the strength of their motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, Catheter
from fluoromap.phantom.chamber import Chamber, spread_over_wall
from fluoromap.phantom.motion import (
    HEART_RATE_HZ,
    ROCKING_MM,
    Beats,
    HeartKind,
    non_affine_vectors,
    wall_vectors,
)
from fluoromap.phantom.shaft import Shaft

Array = NDArray[np.float64]

SEMI_AXES_MM = (22.0, 22.0, 40.0)
RADIUS_6F_MM, RADIUS_7F_MM = 1.0, 1.17
RADIUS_CIRCULAR_MM = 0.75
PACING_SLIP_MM = 1.5
"""Standard deviation an axis of a resting catheter's tip from site to site; the reference does not slip."""
_SEPTUM_MM_PER_MS = 0.6
# Range of the tips' mean excursion along an axis, unless that is too fast at the heart's rate.
_EXCURSION_MM = (4.4, 5.6)
_SOLID_TIP_MM = 3.0
_LONG_MM = 18.0
# Across the ray of a lateral or frontal view. With beat-to-beat variation it stays below 9 px between frames at 60/s.
_FASTEST_MM_PER_S = 88.0


@dataclass(frozen=True, eq=False)
class Resident:
    """A catheter in the heart.

    shaft : at rest. vectors_mm : (MODES, 3) displacement of its tip by each pulse of the beat.
    """

    shaft: Shaft
    vectors_mm: Array


@dataclass(frozen=True, eq=False)
class Anatomy:
    """One heart with its catheters.

    resting : in the right heart, one entry a site: the reference catheter, which is fixed, then the catheters beside it, which slip
    a little when the mapping catheter is turned. mapping : in the left ventricle, one entry a site.
    contacts_mm : (sites, 3) points where the mapping tip's end touches the wall at diastole.
    """

    chamber: Chamber
    rate_hz: float
    resting: tuple[tuple[Resident, ...], ...]
    mapping: tuple[Resident, ...]
    contacts_mm: Array

    def residents(self, site: int) -> tuple[Resident, ...]:
        """Return reference, resting and mapping catheters at a site."""
        return (*self.resting[site], self.mapping[site])


def draw_anatomy(
    heart: HeartKind, sites: int, rng: np.random.Generator, catalogue: Catalogue = DEFAULT_CATALOGUE
) -> Anatomy:
    """Draw a random heart: pose, rate, focus, conduction and motion.

    The first two short catheters beside the mapping catheter lie in the right ventricle, the first long one in the coronary
    sinus, circular ones and all others in the right atrium.
    """
    rate = float(rng.uniform(*HEART_RATE_HZ[heart]))
    chamber, resting = _right_heart(rng, catalogue)
    contacts = spread_over_wall(chamber, sites, rng)
    mapping = [_mapping_shaft(catalogue[catalogue.mapping], chamber, contact, rng) for contact in contacts]

    rocking = rng.normal(size=3)
    rocking *= ROCKING_MM / np.linalg.norm(rocking)
    tips = np.stack([*(shaft.rest_mm[0] for shaft in resting), *contacts])
    # Catheters in the right heart lie on trabeculae or in a vein and follow the wall less, the reference least.
    follow = np.array([*(0.7 if number else 0.5 for number in range(len(resting))), *np.ones(sites)])[:, None, None]
    common = follow * wall_vectors(chamber, tips, rocking)
    own = follow * np.stack([non_affine_vectors(rng) for _ in tips])
    first_mapping = len(resting)
    excursion = float(rng.uniform(*_EXCURSION_MM))
    vectors = _strength(common, own, rate, excursion, first_mapping) * common + own
    slips = np.zeros((sites, len(resting), 3))
    slips[:, 1:] = rng.normal(0, PACING_SLIP_MM, slips[:, 1:].shape)
    return Anatomy(
        chamber,
        rate,
        tuple(
            tuple(
                Resident(shaft.with_tip_displaced(slip), v)
                for shaft, slip, v in zip(resting, at_site, vectors[:first_mapping], strict=True)
            )
            for at_site in slips
        ),
        tuple(Resident(shaft, v) for shaft, v in zip(mapping, vectors[first_mapping:], strict=True)),
        contacts,
    )


def _right_heart(rng: np.random.Generator, catalogue: Catalogue) -> tuple[Chamber, list[Shaft]]:
    """Draw the left ventricle and the resting catheters, the reference first.

    The apex points to the patient's left, front and feet. Without a reference catheter activation times count from the focus.
    """
    apex = np.array([0.55, -0.55, -0.63]) + rng.normal(0, 0.08, 3)
    apex /= np.linalg.norm(apex)
    to_right = np.array([-0.9, -0.4, -0.1]) + rng.normal(0, 0.08, 3)
    to_right -= (to_right @ apex) * apex
    to_right /= np.linalg.norm(to_right)
    axes = np.stack([to_right, np.cross(apex, to_right), apex])
    centre = np.array([3.0, 4.0, 2.0]) + rng.normal(0, 2, 3)

    def in_heart(right: float, across: float, along: float) -> Array:
        return np.asarray(centre + np.array([right, across, along]) @ axes + rng.normal(0, 1.5, 3))

    entry = np.array([-18.0, 8.0, 95.0]) + rng.normal(0, 4, 3)
    atrium = np.array([-26.0, 4.0, 34.0]) + rng.normal(0, 4, 3)
    names = sorted((n for n in catalogue.names if n != catalogue.mapping), key=lambda name: name != catalogue.reference)
    places = _places([catalogue[name] for name in names])
    tips = [in_heart(*place.tip) for _, place in places]
    shafts: dict[str, Shaft] = {}
    for (catheter, place), tip in zip(places, tips, strict=True):
        heading = place.heading + rng.normal(0, 0.13, 3)
        behind = tip - 24 * heading / np.linalg.norm(heading)
        bow = (atrium if place.bow is None else centre + np.array(place.bow) @ axes) + rng.normal(0, 4, 3)
        if place.behind is not None:
            behind = centre + np.array(place.behind) @ axes + rng.normal(0, 2, 3)
        shafts[catheter.name] = _diagnostic(catheter, tip, behind, bow, entry)

    undecided = Chamber(centre, axes, np.array(SEMI_AXES_MM), centre, 1.0, 0.0)
    focus = spread_over_wall(undecided, 1, rng)[0]
    speed = float(rng.uniform(0.6, 1.0))
    from_focus = Chamber(centre, axes, np.array(SEMI_AXES_MM), focus, speed, 0.0)
    resting = [shafts[name] for name in names]
    delay = 0.0
    if resting:
        reference_tip = resting[0].rest_mm[0]
        septum = from_focus.on_wall(reference_tip)
        through_septum = float(np.linalg.norm(reference_tip - septum)) / _SEPTUM_MM_PER_MS
        delay = float(from_focus.activation_ms(septum)) + through_septum
    return Chamber(centre, axes, np.array(SEMI_AXES_MM), focus, speed, delay), resting


@dataclass(frozen=True, slots=True)
class _Place:
    """The course of a catheter in the right heart.

    tip, behind, bow : (right, across, along) in the axes of the ventricle, mm. heading : of the tip, LPS. Without ``behind`` the
    shaft leaves the tip against its heading; without ``bow`` it comes through the right atrium.
    """

    tip: tuple[float, float, float]
    heading: tuple[float, float, float]
    behind: tuple[float, float, float] | None = None
    bow: tuple[float, float, float] | None = None


_VENTRICLE = (
    _Place((27, -5, 20), (0.42, -0.48, -0.78)),
    _Place((29, 8, 2), (0.52, -0.40, -0.72)),
)
_SINUS = _Place((-24, 10, -22), (0.8, 0.3, 0.2), behind=(-8, 40, -26), bow=(36, 44, -30))
_ATRIUM = (
    _Place((22, -14, -20), (0.7, -0.5, -0.5)),
    _Place((44, 12, -26), (0.2, 0.6, -0.8)),
    _Place((34, -24, -34), (-0.3, -0.8, -0.5)),
    _Place((42, 24, -6), (0.5, 0.2, -0.9)),
)


def _places(catheters: Sequence[Catheter]) -> list[tuple[Catheter, _Place]]:
    """Give each catheter its place."""
    ventricle, atrium, sinus = list(_VENTRICLE), list(_ATRIUM), [_SINUS]
    places = []
    for catheter in catheters:
        is_long = float(catheter.arc_lengths_mm[-1]) >= _LONG_MM
        usual = atrium if catheter.is_circular else sinus if is_long else ventricle
        chosen = next(spots for spots in (usual, atrium, ventricle, sinus) if spots)
        places.append((catheter, chosen.pop(0)))
    return places


def _diagnostic(catheter: Catheter, tip: Array, behind: Array, bow: Array, entry: Array) -> Shaft:
    """Make a diagnostic catheter.

    A circular one is a loop about ``tip`` across its heading.
    """
    if catheter.is_circular:
        return Shaft.around(catheter, RADIUS_CIRCULAR_MM, tip, behind - tip, entry)
    return Shaft.through(catheter, RADIUS_6F_MM, False, tip, behind, bow, entry)


def _mapping_shaft(catheter: Catheter, chamber: Chamber, contact_mm: Array, rng: np.random.Generator) -> Shaft:
    """Draw the mapping catheter through aorta and valve.

    Its tip's end lies on the wall.
    """
    inward = chamber.inward(contact_mm)
    valve = chamber.centre_mm - 34 * chamber.axes[2] + rng.normal(0, 2, 3)
    to_valve = valve - contact_mm
    leaving = 0.4 * inward + to_valve / np.linalg.norm(to_valve) + rng.normal(0, 0.2, 3)
    leaving /= np.linalg.norm(leaving)
    # The tip must meet the wall at an angle, not lie along it.
    leaving += max(0.0, 0.25 - float(leaving @ inward)) * inward
    leaving /= np.linalg.norm(leaving)
    bow = valve + 18 * np.array([-0.2, 0.2, 1.0]) + rng.normal(0, 3, 3)
    entry = np.array([-8.0, 10.0, 95.0]) + rng.normal(0, 4, 3)
    is_ablation = catheter.tip_mm >= _SOLID_TIP_MM
    radius = RADIUS_7F_MM if is_ablation else RADIUS_6F_MM
    return Shaft.through(catheter, radius, is_ablation, contact_mm, contact_mm + 22 * leaving, bow, entry)


def _strength(common: Array, own: Array, rate_hz: float, excursion_mm: float, first_mapping: int) -> float:
    """Return the factor of the common motion.

    Mapping tips then move by ``excursion_mm`` an axis on average, and no tip is faster than the limit.
    """
    steps = 60
    times = np.arange(steps) / steps
    pulses = Beats.even(rate_hz, 1 / rate_hz).pulses(times / rate_hz)
    strength = 1.0
    for _ in range(8):
        paths = np.einsum("tm,nmd->tnd", pulses, strength * common + own)
        excursion = np.ptp(paths, axis=0)[first_mapping:].mean()
        velocity = (np.roll(paths, -1, axis=0) - paths) * steps * rate_hz
        speed = max(np.linalg.norm(velocity[..., 1:], axis=2).max(), np.linalg.norm(velocity[..., ::2], axis=2).max())
        strength *= min(excursion_mm / excursion, _FASTEST_MM_PER_S / speed)
    return strength


def electrodes_over_cycle_mm(residents: Sequence[Resident], steps: int) -> Array:
    """Return all electrodes (steps, electrodes, 3) at ``steps`` phases of an average beat."""
    pulses = Beats.even(1.0, 1.0).pulses(np.arange(steps) / steps)
    return np.concatenate([r.shaft.electrodes_mm(r.shaft.lines_mm(pulses @ r.vectors_mm)) for r in residents], axis=1)
