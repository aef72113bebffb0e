"""Conditions of simulated studies: the ways in which real studies differ from a calm one, drawn from stated distributions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

Rhythm = Literal["regular", "irregular", "fibrillation"]
Property = Literal[
    "bend",
    "tip",
    "catalogue",
    "rhythm",
    "breathing",
    "gantry",
    "table",
    "decapolar",
    "look-alikes",
    "biplane",
    "timing",
]
PROPERTIES: tuple[Property, ...] = get_args(Property)
"""Everything in which a study can differ from a calm one."""

CATHETERS = 3
MEASURED_ANGLE_SD_DEG, MEASURED_OFFSET_SD_MM, MEASURED_SCALE_SD = 0.28, 0.65, 0.003
"""Gantry errors of a real C-arm, an axis: centre of the ranges 0.2 to 0.33 degree and 0.5 to 0.8 mm."""
_TAIL_SCALES, _TAIL_SHARES = (1.0, 2.0, 4.0), (0.7, 0.22, 0.08)
"""Errors of a C-arm against those of the measured one, and the share of C-arms with each."""
LARGEST_ANGLE_DEG, LARGEST_OFFSET_MM = 1.5, 4.0


@dataclass(frozen=True, slots=True)
class GantryError:
    """Difference between a view's true gantry and its header.

    rotation_deg : rotation vector about the isocentre. offset_mm : along the world's axes. scale : relative error of the
    source-to-detector distance.
    """

    rotation_deg: tuple[float, float, float]
    offset_mm: tuple[float, float, float]
    scale: float

    @classmethod
    def draw(cls, factor: float, rng: np.random.Generator) -> GantryError:
        """Draw an error of the size measured on a real C-arm, times ``factor``.

        The rotation is at most 1.5 degrees and the offset at most 4 mm.
        """
        rotation = factor * MEASURED_ANGLE_SD_DEG * rng.normal(size=3)
        offset = factor * MEASURED_OFFSET_SD_MM * rng.normal(size=3)
        rotation *= min(1.0, LARGEST_ANGLE_DEG / float(np.linalg.norm(rotation)))
        offset *= min(1.0, LARGEST_OFFSET_MM / float(np.linalg.norm(offset)))
        scale = float(np.clip(MEASURED_SCALE_SD * rng.normal(), -0.008, 0.008))
        return cls(
            (float(rotation[0]), float(rotation[1]), float(rotation[2])),
            (float(offset[0]), float(offset[1]), float(offset[2])),
            scale,
        )


@dataclass(frozen=True, slots=True)
class TableMove:
    """A move of the table between the two runs of one site; the table keeps its new position afterwards.

    site : index of that site. displacement_mm : of the patient, world. in_header : the files state the table's position.
    """

    site: int
    displacement_mm: tuple[float, float, float]
    in_header: bool


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions of one simulated study. The defaults describe a calm study.

    Parameters
    ----------
    seed : int
        Seed of the heart and of everything that is drawn while the study is simulated.
    sites : int
        Mapping sites.
    gantry_errors : pair of GantryError
        Errors of view a and b.
    bends_deg : tuple of float
        Angle of a local bend of the reference, pacing and mapping catheter among their electrodes.
    tip_offsets_mm : tuple of float
        Distance along the shaft from the tip electrode's middle to its centre in the image, for each catheter.
    catalogue_errors_mm : tuple of tuple of float
        Catalogue's distances minus the true ones, three for each catheter.
    rhythm : {"regular", "irregular", "fibrillation"}
    beat_scale : float
        Variation from beat to beat as a multiple of the phantom's usual one.
    breathing_mm : float
        Largest displacement of the heart to head or feet between runs.
    table : TableMove or None
    decapolar : bool
        A catheter with ten electrodes that the catalogue does not list.
    pacing_slip : float
        Motion of the pacing catheter from site to site as a multiple of the phantom's usual one.
    mapping_looks_alike : bool
        The mapping catheter has the same electrodes as the other two.
    simultaneous : bool
        Both views are recorded at the same time.
    r_waves : bool
        The files state the R waves.
    frame_rate_hz, seconds : float
        Of every run.
    """

    seed: int
    sites: int
    gantry_errors: tuple[GantryError, GantryError]
    bends_deg: tuple[float, ...] = (0.0,) * CATHETERS
    tip_offsets_mm: tuple[float, ...] = (0.0,) * CATHETERS
    catalogue_errors_mm: tuple[tuple[float, ...], ...] = ((0.0,) * 3,) * CATHETERS
    rhythm: Rhythm = "regular"
    beat_scale: float = 0.4
    breathing_mm: float = 0.5
    table: TableMove | None = None
    decapolar: bool = False
    pacing_slip: float = 1.0
    mapping_looks_alike: bool = False
    simultaneous: bool = False
    r_waves: bool = True
    frame_rate_hz: float = 15.0
    seconds: float = 2.0

    @classmethod
    def draw(cls, seed: int, properties: tuple[Property, ...] = PROPERTIES, sites: int | None = None) -> Conditions:
        """Draw the conditions of a study; only the named properties differ from a calm study.

        A property that is drawn is not always present: of all studies, a third has a moved table, a third an unlisted
        catheter, a third look-alikes, and a fifth is biplane. A study with one property alone always has it.
        """
        rng = np.random.default_rng([seed, 77])
        count = int(rng.integers(4, 9)) if sites is None else sites
        drawn = float(rng.choice(_TAIL_SCALES, p=_TAIL_SHARES))
        # One C-arm takes both views.
        factor = drawn if "gantry" in properties else 1.0
        found = cls(seed, count, (GantryError.draw(factor, rng), GantryError.draw(factor, rng)))
        alone = len(properties) == 1
        for name in PROPERTIES:
            # Every property is drawn, so that a study keeps its other properties when one is left out.
            changed = _draw(found, name, alone, np.random.default_rng([seed, 78, PROPERTIES.index(name)]))
            found = changed if name in properties else found
        return found


def _draw(calm: Conditions, name: Property, always: bool, rng: np.random.Generator) -> Conditions:
    """Return the conditions with one property drawn."""
    present = rng.uniform()
    match name:
        case "bend":
            return replace(calm, bends_deg=tuple(float(angle) for angle in rng.uniform(0, 90, CATHETERS)))
        case "tip":
            offsets = rng.uniform(0.1, 0.3, CATHETERS) * rng.choice([-1.0, 1.0], CATHETERS)
            return replace(calm, tip_offsets_mm=tuple(float(offset) for offset in offsets))
        case "catalogue":
            errors = rng.uniform(-0.5, 0.5, (CATHETERS, 3)) * (rng.uniform(size=(CATHETERS, 1)) < 0.5)
            return replace(calm, catalogue_errors_mm=tuple(tuple(float(one) for one in row) for row in errors))
        case "rhythm":
            kinds: tuple[Rhythm, ...] = ("irregular", "fibrillation") if always else get_args(Rhythm)
            rhythm = kinds[int(rng.integers(len(kinds)))]
            return replace(calm, rhythm=rhythm, beat_scale=float(rng.uniform(0.3, 1.5)))
        case "breathing":
            return replace(calm, breathing_mm=float(rng.uniform(0, 8)))
        case "gantry":
            return calm
        case "table":
            direction = rng.normal(size=3) * [1.0, 0.4, 1.0]
            moved = direction / np.linalg.norm(direction) * rng.uniform(5, 40)
            table = TableMove(
                int(rng.integers(calm.sites)), (float(moved[0]), float(moved[1]), float(moved[2])),
                bool(rng.uniform() < 0.5),
            )  # fmt: skip
            return replace(calm, table=table) if always or present < 1 / 3 else calm
        case "decapolar":
            return replace(calm, decapolar=always or present < 1 / 3)
        case "look-alikes":
            if not (always or present < 1 / 3):
                return calm
            return replace(
                calm, mapping_looks_alike=bool(rng.uniform() < 0.3), pacing_slip=float(rng.uniform(0.1, 0.6))
            )
        case "biplane":
            return replace(calm, simultaneous=always or present < 1 / 5)
        case "timing":
            rate = float(rng.choice([7.5, 10.0, 15.0, 30.0, 60.0], p=[0.3, 0.15, 0.3, 0.2, 0.05]))
            seconds = float(np.exp(rng.uniform(np.log(0.7), np.log(6.0))))
            return replace(calm, frame_rate_hz=rate, seconds=seconds, r_waves=bool(rng.uniform() < 0.6))
