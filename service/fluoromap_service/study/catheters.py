"""A study's catheters, and the roles that two of them have."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from fluoromap.catheters import Catalogue, Catheter
from fluoromap_service.problem import Problem
from fluoromap_service.store.models import Study


class StudyCatheter(BaseModel):
    """A catheter of a study, as the store, the snapshot and the answers of the API hold it; electrode 1 is the tip.

    spacing_mm : from electrode centre to electrode centre along the shaft, from the tip on.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    electrodes: int
    spacing_mm: tuple[float, ...]
    tip_mm: float
    ring_mm: float

    @classmethod
    def of(cls, catheter: Catheter) -> StudyCatheter:
        """Return a catheter of the science in this form."""
        return cls(
            name=catheter.name,
            electrodes=catheter.electrodes,
            spacing_mm=catheter.spacing_mm,
            tip_mm=catheter.tip_mm,
            ring_mm=catheter.ring_mm,
        )

    def catheter(self) -> Catheter:
        """Return the catheter as the science takes it."""
        return Catheter(**self.model_dump())


def catheters_of(study: Study) -> tuple[StudyCatheter, ...]:
    """Return the study's catheters."""
    return tuple(StudyCatheter.model_validate(row) for row in study.catheters)


def catalogue_of(study: Study) -> Catalogue:
    """Return the study's catheters with their roles."""
    return Catalogue(tuple(each.catheter() for each in catheters_of(study)), study.reference, study.mapping)


def set_catalogue(study: Study, catalogue: Catalogue) -> None:
    """Give a study its catheters and their roles."""
    study.catheters = [StudyCatheter.of(catheter).model_dump(mode="json") for catheter in catalogue.catheters]
    study.reference, study.mapping = catalogue.reference, catalogue.mapping


def catalogue_with_roles(catheters: tuple[Catheter, ...], reference: str | None) -> Catalogue:
    """Return a catalogue of these catheters with their roles.

    The mapping catheter is the one named ``mapping``, otherwise the one with the longest tip. The reference catheter is
    ``reference``, otherwise the one named ``reference``, otherwise the first that does not map. A single catheter maps, and
    its study has no reference.

    Raises
    ------
    Problem
        422 when names repeat, or when ``reference`` names no catheter or the mapping catheter.
    """
    names = [catheter.name for catheter in catheters]
    mapping = "mapping" if "mapping" in names else max(catheters, key=lambda catheter: catheter.tip_mm).name
    if reference is None:
        others = [name for name in names if name != mapping]
        reference = "reference" if "reference" in others else next(iter(others), None)
    elif reference not in names:
        raise _unusable("reference", f"no catheter is named {reference!r}")
    elif reference == mapping:
        raise _unusable("reference", f"{reference!r} is the mapping catheter; name another catheter or leave this out")
    try:
        return Catalogue(catheters, reference, mapping)
    except ValueError as error:
        raise _unusable("catheters", str(error)) from None


def _unusable(where: str, message: str) -> Problem:
    return Problem(422, "invalid_catheters", "The study cannot use these catheters; see 'errors'.", [(where, message)])
