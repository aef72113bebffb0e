"""No half-valid objects travel between stages."""

import numpy as np
import pytest

from fluoromap.contracts import (
    CHI2_95_3D,
    Chain,
    ElectrodePoint,
    FrameChains,
    Grade,
    Refusal,
    Segmentation,
    SiteCycle,
    Track,
    frozen,
    grade_of,
)
from fluoromap.reasons import Reason


def chain(electrodes: tuple[int, ...] = (1, 2), **changes: object) -> Chain:
    m = len(electrodes)
    values: dict[str, object] = {
        "electrodes": electrodes, "pixels_uv": np.zeros((m, 2)), "covariance_px2": np.zeros((m, 2, 2)),
        "scores": np.ones(m), "kinds": (("mapping", 1.0),),
    }  # fmt: skip
    return Chain(**{**values, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("semi_axis_mm", "grade"), [(1.99, Grade.A), (2.01, Grade.B), (3.99, Grade.B), (4.01, Grade.C)]
)
def test_grade_is_by_the_largest_semi_axis_whatever_its_direction(semi_axis_mm: float, grade: Grade) -> None:
    rotation, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    covariance = rotation @ np.diag([semi_axis_mm**2, 0.01, 0.01]) @ rotation.T / CHI2_95_3D
    assert grade_of(covariance) is grade


def test_chi_squared_radius_holds_ninety_five_percent() -> None:
    squared = (np.random.default_rng(2).normal(size=(200_000, 3)) ** 2).sum(axis=1)
    assert (squared <= CHI2_95_3D).mean() == pytest.approx(0.95, abs=0.002)


def test_frozen_arrays_are_copies_that_cannot_be_changed() -> None:
    mine = np.zeros(3)
    kept = frozen(mine, (3,), "mine")
    mine[0] = 1
    assert kept[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        kept[0] = 1


@pytest.mark.parametrize("value", [np.zeros(2), np.zeros((3, 1)), [0.0, np.nan, 0.0]])
def test_wrong_shapes_and_numbers_name_the_field(value: object) -> None:
    with pytest.raises(ValueError, match="tip"):
        frozen(value, (3,), "tip")  # type: ignore[arg-type]


@pytest.mark.parametrize("electrodes", [(), (2, 1), (1, 1), (0, 1)])
def test_electrodes_of_a_chain_are_ascending_numbers_from_one(electrodes: tuple[int, ...]) -> None:
    with pytest.raises(ValueError):
        chain(electrodes)


def test_kinds_of_a_chain_are_probabilities() -> None:
    assert chain().probability("mapping") == 1
    assert chain().probability("pacing") == 0
    with pytest.raises(ValueError, match="probabilities"):
        chain(kinds=(("mapping", 0.8), ("pacing", 0.4)))


def test_a_segmentation_holds_every_frame_in_order() -> None:
    frames = (FrameChains(1, ()), FrameChains(0, ()))
    with pytest.raises(ValueError, match="order"):
        Segmentation(frames, None, (), np.zeros(2), np.arange(2.0))


def test_a_relative_position_needs_its_covariance() -> None:
    with pytest.raises(ValueError, match="relative"):
        ElectrodePoint("mapping", 1, np.zeros(3), np.eye(3), np.zeros(3), None, (0.1, 0.1), 90.0)


@pytest.mark.parametrize("with_reference", [True, False])
def test_points_of_a_moment_are_those_that_are_made_one_by_one(with_reference: bool) -> None:
    random = np.random.default_rng(3)
    positions, relative = random.normal(size=(2, 3, 3))
    covariances, relative_mm2 = random.normal(size=(2, 3, 3, 3))
    own = (relative, relative_mm2) if with_reference else (None, None)
    labels, angles = [("cs", 1), ("cs", 2), ("map", 1)], [80.0, 81.0, 82.0]
    residuals, reasons = [(0.1, 0.2), (0.3, 0.4), (0.5, 0.6)], [(), (Reason.SPACING_MISMATCH,), ()]
    points = ElectrodePoint.of_moment(labels, positions, covariances, *own, residuals, angles, reasons)
    for i, point in enumerate(points):
        single = ElectrodePoint(
            *labels[i], positions[i], covariances[i], *(None if of is None else of[i] for of in own), residuals[i],
            angles[i], reasons[i],
        )  # fmt: skip
        assert vars(point).keys() == vars(single).keys()
        for name, value in vars(single).items():
            np.testing.assert_array_equal(getattr(point, name), value)
            if isinstance(value, np.ndarray):
                assert not getattr(point, name).flags.writeable
    with pytest.raises(ValueError, match="needs its covariance"):
        ElectrodePoint.of_moment(labels, positions, covariances, relative, None, residuals, angles, reasons)


def test_cycles_and_tracks_agree_with_their_labels() -> None:
    with pytest.raises(ValueError, match="positions_mm"):
        SiteCycle(np.array([0.1]), (("mapping", 1),), np.zeros((1, 2, 3)), np.zeros((1, 2, 3, 3)))
    n, labels = 2, (("mapping", 1),)
    arrays = (np.zeros((n, 1, 3)), np.zeros((n, 1, 3)), np.zeros((n, 1, 3, 3)), np.zeros((n, 1, 2)))
    with pytest.raises(ValueError, match="reasons"):
        Track(labels, np.ones((n, 1), dtype=bool), *arrays, reasons=())


def test_the_covariances_of_a_track_are_symmetric_bit_for_bit() -> None:
    n, rounded = 4, np.array([[2.0, np.nextafter(0.3, 1), 0.1], [0.3, 3.0, 0.2], [0.1, 0.2, 4.0]])
    covariances = np.broadcast_to(rounded, (n, 1, 3, 3))
    track = Track(
        (("mapping", 1),), np.ones((n, 1), dtype=bool), np.zeros((n, 1, 3)), np.zeros((n, 1, 3)), covariances,
        np.zeros((n, 1, 2)), reasons=((),), relative_covariance_mm2=covariances,
    )  # fmt: skip
    for stored in (track.covariance_mm2, track.relative_covariance_mm2):
        assert stored is not None
        np.testing.assert_array_equal(stored, stored.transpose(0, 1, 3, 2))
        np.testing.assert_allclose(stored, covariances, rtol=1e-15)
        assert not stored.flags.writeable


def test_a_refusal_says_its_reason_s_sentence_unless_given_a_better_one() -> None:
    assert str(Refusal(Reason.NO_A_PRIORI)) == Reason.NO_A_PRIORI.sentence
    assert str(Refusal(Reason.DEPTH_UNOBSERVABLE, "17 mm")) == "17 mm"


def test_a_grade_is_the_worse_of_covariance_and_doubt() -> None:
    small, large = 0.01 * np.eye(3), 10.0 * np.eye(3)
    assert grade_of(small) is Grade.A
    assert grade_of(small, [Reason.IDENTITY_BY_MOTION]) is Grade.A
    assert grade_of(small, [Reason.CATALOGUE_CONTRADICTED]) is Grade.B
    assert grade_of(large, [Reason.CATALOGUE_CONTRADICTED]) is Grade.C
    for reason in (Reason.IDENTITY_UNCERTAIN, Reason.TABLE_MOVED, Reason.GEOMETRY_DOUBTFUL, Reason.EXTRA_CATHETER):
        assert grade_of(small, [reason]) is Grade.C
