"""The stored form of the contracts: exact, and equal for equal values."""

import dataclasses
import datetime
import typing
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from fluoromap.contracts import Array, Chain, FrameChains, Segmentation
from fluoromap.geometry import Camera, Gantry, camera_from_gantry
from fluoromap.reasons import Reason
from fluoromap_service.store import array_pools, codec
from fluoromap_service.store.codec import (
    StoredOtherwise,
    block_hash,
    block_of,
    decode,
    deferred,
    encode,
    partial_results,
    plain_form,
    undecoded,
)
from fluoromap_service.store.value_hash import digest


@dataclasses.dataclass(frozen=True)
class _Number:
    number: float
    text: str = "NaN"


@dataclasses.dataclass(frozen=True)
class _Numbers:
    numbers: Array


@dataclasses.dataclass(frozen=True)
class _Matrices:
    matrices: tuple[Array, ...]


@dataclasses.dataclass(frozen=True)
class _Texts:
    texts: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class _Tree:
    label: str | None
    branches: "tuple[_Tree, ...]" = ()
    pairs: tuple[tuple[str, Array | None], ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class _Apart:
    stored_apart: ClassVar[bool] = True

    name: str
    numbers: Array
    note: str | None = "none"


@dataclasses.dataclass(frozen=True)
class _Whole:
    parts: tuple[_Apart, ...]


def _segmentation() -> Segmentation:
    chain = Chain(
        electrodes=(1, 3),
        pixels_uv=np.array([[0.1, 1 / 3], [np.pi, 1e-17]]),
        covariance_px2=np.stack([np.eye(2), np.eye(2) / 7]),
        scores=np.array([1.0, 2.5]),
        kinds=(("mapping", 0.9),),
        track=2,
    )
    frames = (FrameChains(0, (chain,)), FrameChains(1, (), Reason.MANUAL_NEEDED))
    return Segmentation(frames, frames[0], (0,), np.array([0.5, 0.5]), np.array([0.0, 66.7]), (1,))


def test_a_segmentation_comes_back_bit_for_bit() -> None:
    before = _segmentation()
    after = decode(Segmentation, encode(before))
    assert encode(after) == encode(before)
    assert after.frames[1].manual_needed is Reason.MANUAL_NEEDED
    assert after.diastole is not None
    np.testing.assert_array_equal(after.diastole.chains[0].pixels_uv, before.frames[0].chains[0].pixels_uv)
    assert isinstance(after.frames, tuple)
    assert after.frames[0].chains[0].kinds == (("mapping", 0.9),)


def test_a_camera_comes_back_bit_for_bit() -> None:
    camera = camera_from_gantry(Gantry(31.7, -12.3, 1011.0, 723.0, (0.3, 0.31), 512, 640))
    after = decode(Camera, encode(camera))
    np.testing.assert_allclose(after.matrix, camera.matrix, rtol=1e-15)


def test_empty_arrays_and_missing_values_keep_their_shape() -> None:
    before = dataclasses.replace(_segmentation(), diastole=None, r_wave_frames=())
    after = decode(Segmentation, encode(before))
    assert after.diastole is None
    assert after.r_wave_frames == ()


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    "holder", [_Number, lambda number: _Number(np.float64(number)), lambda number: _Numbers(np.array(number))]
)
def test_what_is_not_a_number_is_refused(number: float, holder: Callable[[float], Any]) -> None:
    with pytest.raises(ValueError, match="finite"):
        encode(holder(number))


def test_a_text_may_say_that_something_is_not_a_number() -> None:
    assert decode(_Texts, encode(_Texts(("NaN", "-Infinity")))) == _Texts(("NaN", "-Infinity"))


@pytest.mark.parametrize(
    "value",
    [
        object(), {"a", "b"}, {"key": 1}, b"bytes", iter([1]), datetime.date(2026, 1, 1), 1j, np.complex128(1j),
        np.array([1j]), np.array([None]),
    ],
)  # fmt: skip
def test_what_would_not_come_back_as_it_was_is_refused(value: Any) -> None:
    for holder in (_Number(value), _Numbers(value), _Texts((value,)), _Tree(None, (value,)), value):
        with pytest.raises(TypeError, match="never stored"):
            encode(holder)


@pytest.mark.parametrize("number", [np.float64(0.1), np.int32(7), np.bool_(True)])
def test_a_number_of_numpy_comes_back_as_one_of_python(number: Any) -> None:
    after = decode(_Number, encode(_Number(number))).number
    assert after == number.item()
    assert type(after) is type(number.item())


def test_equal_arrays_are_stored_once() -> None:
    once = encode(_Tree(None, pairs=(("a", np.arange(1000.0)),)))
    twice = encode(_Tree(None, pairs=(("a", np.arange(1000.0)), ("b", np.arange(1000.0)))))
    assert len(twice) < len(once) + 100


def test_a_tree_of_its_own_kind_comes_back() -> None:
    leaf = _Tree("leaf", pairs=(("none", None), ("some", np.arange(3, dtype=">i2"))))
    before = _Tree(None, (leaf, _Tree("empty"), _Tree("twig", (leaf,))))
    after = decode(_Tree, encode(before))
    assert encode(after) == encode(before)
    assert [branch.label for branch in after.branches] == ["leaf", "empty", "twig"]
    assert after.branches[2].branches[0].pairs[0] == ("none", None)
    np.testing.assert_array_equal(after.branches[0].pairs[1][1], [0, 1, 2])


@pytest.mark.parametrize("cut", [0, 4, 8, 20, 200, -1])
def test_bytes_that_are_cut_off_are_no_stored_result(cut: int) -> None:
    with pytest.raises(StoredOtherwise):
        decode(Segmentation, encode(_segmentation())[:cut])


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1))
def test_numbers_come_back_bit_for_bit(numbers: list[float]) -> None:
    before = np.array(numbers)
    assert decode(_Numbers, encode(_Numbers(before))).numbers.tobytes() == before.tobytes()


def _whole() -> _Whole:
    return _Whole((_Apart("a", np.arange(4.0)), _Apart("b", np.arange(2), None), _Apart("a", np.arange(4.0))))


def test_a_value_that_is_stored_apart_comes_back_field_by_field() -> None:
    after = decode(_Whole, encode(_whole()))
    assert [part.name for part in after.parts] == ["a", "b", "a"]
    assert [part.note for part in after.parts] == ["none", None, "none"]
    np.testing.assert_array_equal(after.parts[0].numbers, np.arange(4.0))
    assert all(isinstance(part, _Apart) for part in after.parts)
    changed = dataclasses.replace(after.parts[0], name="c")
    assert (changed.name, changed.note) == ("c", "none")
    with pytest.raises(dataclasses.FrozenInstanceError):
        after.parts[0].name = "d"  # type: ignore[misc]


def test_an_unchanged_part_is_stored_again_without_being_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    before = encode(_whole())
    after = decode(_Whole, before)
    monkeypatch.setattr(codec._Content, "field", None)
    assert encode(after) == before


def test_equal_parts_are_stored_once() -> None:
    one, three = (encode(_Whole((_Apart("a", np.arange(1000.0)),) * count)) for count in (1, 3))
    assert len(three) < len(one) + 100


def test_partial_results_lie_in_the_file_of_a_result() -> None:
    part = block_of(_Number(np.inf), finite=False)
    content = encode(_whole(), {"key": part})
    assert partial_results(content) == {"key": part}
    assert decode(_Number, part.content).number == np.inf
    assert encode(decode(_Whole, content)) == encode(_whole())


def test_a_deferred_value_is_read_when_a_field_is_read() -> None:
    content, reads = encode(_segmentation()), []
    value = deferred(Segmentation, "hash", lambda: reads.append(1) or content)
    assert digest(value) == digest(deferred(Segmentation, "hash", lambda: content))
    assert reads == []
    assert value.r_wave_frames == (1,)
    assert len(value.frames) == 2
    assert reads == [1]


def test_a_deferred_value_of_another_form_says_so() -> None:
    value = deferred(Segmentation, "hash", lambda: encode(_whole()))
    with pytest.raises(StoredOtherwise):
        _ = value.frames


def test_no_types_are_looked_up_while_a_prepared_kind_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    content = encode(_whole())
    codec._form_of.cache_clear()
    codec.prepare(_Whole)

    def never(*_: object) -> object:
        raise AssertionError("the types are looked up")

    monkeypatch.setattr(typing, "get_type_hints", never)
    assert decode(_Whole, content).parts[1].name == "b"


def test_an_undecoded_copy_has_the_fields_and_the_hash_of_its_value() -> None:
    content = encode(_segmentation())
    value = deferred(Segmentation, "hash", lambda: content)
    times = value.frame_times_ms
    copy = undecoded(value)
    assert "frame_times_ms" not in vars(copy)
    np.testing.assert_array_equal(copy.frame_times_ms, times)
    assert block_hash(copy) == block_hash(value) == "hash"
    whole = _segmentation()
    assert undecoded(whole) is whole


def test_a_digest_distinguishes_types_and_places() -> None:
    values = [
        (1,), (1.0,), ("1",), (True,), (None,), ((1,),), (1, 2), ((1, 2),), (np.arange(2),), (np.arange(2.0),),
        ({"a": 1},), ({"a": 2},), (Reason.NO_ELECTRODES,), ("NO_ELECTRODES",), (_whole().parts[0],), (_whole().parts[1],),
    ]  # fmt: skip
    assert len({digest(*value) for value in values}) == len(values)
    assert digest(_whole()) == digest(decode(_Whole, encode(_whole())))
    with pytest.raises(TypeError, match="never stored"):
        digest(object())


def _covariances(count: int, side: int) -> Array:
    roots = np.random.default_rng(5).normal(size=(count, side, side))
    covariances = roots @ roots.transpose(0, 2, 1)
    return 0.5 * (covariances + covariances.transpose(0, 2, 1))


@pytest.mark.parametrize("side", [2, 3, 4])
def test_only_the_upper_halves_of_symmetric_matrices_are_stored(side: int) -> None:
    before = _covariances(500, side)
    content = encode(_Numbers(before))
    assert decode(_Numbers, content).numbers.tobytes() == before.tobytes()
    assert len(content) < before.nbytes * (side + 1) / (2 * side) + 200


def test_a_matrix_whose_halves_differ_by_a_bit_comes_back_with_both() -> None:
    before = _covariances(500, 3)
    before[7, 0, 1] = np.nextafter(before[7, 0, 1], np.inf)
    before[8, 0, 1], before[8, 1, 0] = 0.0, -0.0
    assert decode(_Numbers, encode(_Numbers(before))).numbers.tobytes() == before.tobytes()


def test_tracks_need_less_than_their_numbers() -> None:
    phases = np.linspace(0, 20, 120)[:, None, None] + np.arange(12)[:, None] / 7
    before = 60 + 5 * np.sin(phases) * np.array([1.0, 0.7, 0.3])
    assert len(encode(_Numbers(before))) < 0.9 * before.nbytes
    assert len(encode(_Numbers(before.astype(np.float32).astype(np.float64)))) < 0.55 * before.nbytes


@given(
    arrays.array_shapes(min_dims=1, max_dims=4, min_side=0, max_side=6).flatmap(
        lambda shape: arrays.arrays(
            st.sampled_from(["<f8", "<f4", ">f8", "<i8", "<i4", "|u1", "|b1"]),
            shape,
            elements={"allow_nan": False, "allow_infinity": False},
        )
    )
)
def test_arrays_of_any_type_and_shape_come_back_bit_for_bit(before: np.ndarray[Any, Any]) -> None:
    values = _Matrices((before, np.concatenate([before] * 40), np.swapaxes(before, 0, -1)))
    for stored, after in zip(values.matrices, decode(_Matrices, encode(values)).matrices, strict=True):
        assert (after.dtype, after.shape, after.tobytes()) == (stored.dtype, stored.shape, stored.tobytes())


@pytest.mark.parametrize("count", [40, 400])
def test_arrays_of_a_partial_result_are_stored_once(count: int) -> None:
    shared = tuple(np.random.default_rng(6).normal(size=(count, 8, 3)))
    part = block_of(_Matrices(shared))
    before = _Matrices((np.zeros((8, 3)), *shared[1::2], np.arange(3.0), *shared[::2]))
    content = encode(before, {"key": part})
    assert len(content) < len(part.content) + 6 * count + 300
    after = decode(_Matrices, content)
    assert [array.tobytes() for array in after.matrices] == [array.tobytes() for array in before.matrices]
    assert partial_results(content) == {"key": part}


def test_a_single_field_with_shared_arrays_is_read_alone() -> None:
    numbers = np.random.default_rng(6).normal(size=1000)
    part = block_of(_Numbers(numbers))
    content = encode(_Apart("a", numbers), {"key": part})
    assert len(content) < len(part.content) + 300
    value = deferred(_Apart, "hash", lambda: content)
    np.testing.assert_array_equal(value.numbers, numbers)


def test_nobody_can_write_to_an_array_that_was_read() -> None:
    for numbers in (np.arange(3.0), np.arange(500.0), _covariances(50, 3)):
        after = decode(_Numbers, encode(_Numbers(numbers))).numbers
        with pytest.raises(ValueError, match="WRITEABLE"):
            after.setflags(write=True)


@pytest.mark.parametrize("part", range(12))
def test_damaged_bytes_are_no_stored_result_or_other_numbers(part: int) -> None:
    before = _Matrices((np.sin(np.arange(2000.0)), _covariances(100, 3), np.arange(3)))
    content = encode(before, {"key": block_of(_Numbers(np.arange(100.0)))})
    for place in range(part, len(content), 97):
        damaged = content[:place] + bytes([content[place] ^ 0x55]) + content[place + 1 :]
        try:
            after = decode(_Matrices, damaged)
        except StoredOtherwise:
            continue
        assert [array.shape for array in after.matrices] == [array.shape for array in before.matrices]
    for place in range(part, len(content) - len(block_of(_Numbers(np.arange(100.0))).content), 97):
        with pytest.raises(StoredOtherwise):
            decode(_Matrices, content[:place])


def test_another_compressor_changes_no_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    value = _Numbers(np.sin(np.arange(2000.0)))
    before = block_of(value)
    monkeypatch.setattr(array_pools, "_MOST_BITS", 0.0)
    after = block_of(value)
    assert after.sha256 == before.sha256
    assert after.content != before.content
    assert plain_form(_whole()) == plain_form(decode(_Whole, encode(_whole())))
