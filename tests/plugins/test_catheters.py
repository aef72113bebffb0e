"""The catheter catalogue."""

import pytest

from fluoromap.catheters import CATHETER_TYPES, DEFAULT_CATALOGUE, Catalogue, Catheter, catheter_type


def test_edge_spacings_become_the_default_catalogue_s_centre_spacings() -> None:
    diagnostic = Catheter.from_edge_spacing("reference", 4, (2, 5, 2), tip_mm=2, ring_mm=1)
    ablation = Catheter.from_edge_spacing("mapping", 4, (2, 5, 2), tip_mm=4, ring_mm=1.3)
    assert diagnostic.spacing_mm == pytest.approx(DEFAULT_CATALOGUE["reference"].spacing_mm)
    assert ablation.spacing_mm == pytest.approx(DEFAULT_CATALOGUE["mapping"].spacing_mm)
    assert diagnostic.arc_lengths_mm == pytest.approx([0, 3.5, 9.5, 12.5])


def test_look_alikes_are_those_with_the_same_lengths() -> None:
    reference, pacing, mapping = DEFAULT_CATALOGUE.catheters
    assert reference.looks_like(pacing)
    assert not reference.looks_like(mapping)
    assert not reference.looks_like(Catheter("deca", 10, (5.0,) * 9, 2, 1))


@pytest.mark.parametrize(
    "wrong",
    [
        {"name": ""}, {"name": "x" * 65}, {"electrodes": 1, "spacing_mm": ()}, {"electrodes": 65, "spacing_mm": (1.0,) * 64},
        {"spacing_mm": (3.5, 6.0)}, {"spacing_mm": (3.5, -6.0, 3.0)}, {"tip_mm": float("nan")}, {"ring_mm": 0.0},
    ],
)  # fmt: skip
def test_numbers_that_describe_no_catheter_are_refused(wrong: dict[str, object]) -> None:
    right: dict[str, object] = {
        "name": "one", "electrodes": 4, "spacing_mm": (3.5, 6.0, 3.0), "tip_mm": 2.0, "ring_mm": 1.0,
    }  # fmt: skip
    with pytest.raises(ValueError):
        Catheter(**{**right, **wrong})  # type: ignore[arg-type]


def test_a_catalogue_needs_different_names_and_two_roles() -> None:
    one, two, _ = DEFAULT_CATALOGUE.catheters
    with pytest.raises(ValueError, match="differ"):
        Catalogue((one, one), "reference", "reference")
    with pytest.raises(ValueError, match="named"):
        Catalogue((one, two), "reference", "mapping")
    with pytest.raises(ValueError, match="differ"):
        Catalogue((one, two), "reference", "reference")
    with pytest.raises(ValueError, match="must be the reference"):
        Catalogue((one, two), None, "reference")
    assert Catalogue((one,), None, "reference").names == ("reference",)
    with pytest.raises(KeyError):
        DEFAULT_CATALOGUE["nobody"]


def test_types_by_name_have_their_makers_spacings() -> None:
    cs = catheter_type("decapolar-2-5-2", "coronary sinus")
    assert cs.name == "coronary sinus"
    assert cs.electrodes == 10
    assert cs.spacing_mm == pytest.approx((3.5, 6, 3, 6, 3, 6, 3, 6, 3))
    assert catheter_type("ablation-4", "mapping").looks_like(DEFAULT_CATALOGUE["mapping"])
    with pytest.raises(ValueError, match="decapolar-2-5-2"):
        catheter_type("decapolar", "cs")


@pytest.mark.parametrize("name", CATHETER_TYPES)
def test_every_type_describes_a_catheter(name: str) -> None:
    assert 2 <= catheter_type(name, "one").electrodes <= 20
