"""From the header's word on intensities to electrodes: files by pydicom, the reader, the segmenter."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import FrameChains, Run, Silent
from fluoromap.phantom import SimulatedRun, StudySpec, simulate_study
from fluoromap.segmenter.learned_chain.plugin import LearnedChain
from fluoromap_service.dicom import HeaderWarning, open_frames, read_instance

MakeXa = Callable[..., Path]
PX_PER_MM = 512 / 178 * 2
FRAMES = 4


@pytest.fixture(scope="module")
def simulated() -> SimulatedRun:
    spec = StudySpec(313, sites=1, frames=FRAMES, frame_rate_hz=60.0, heart="dog", contrast=("LAT", "PA"))
    return simulate_study(spec).sites[0].runs[0]


@pytest.fixture(scope="module")
def linear(simulated: SimulatedRun) -> NDArray[np.uint16]:
    """Photon counts, 12 bits."""
    return np.stack([simulated.frames[k] for k in range(FRAMES)])


@pytest.fixture(scope="module")
def displayed(linear: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """The same as a system shows it: compressed range, 8 bits."""
    level = np.log(linear.astype(np.float64) + 1.0)
    low, high = np.percentile(level, [0.5, 99.5])
    return (np.clip((level - low) / (high - low), 0, 1) * 255).astype(np.uint8)


def segmented(path: Path) -> tuple[FrameChains, ...]:
    facts = read_instance(path)
    run = Run(open_frames(path, facts), np.array(facts.frame_times_ms), PX_PER_MM, facts.pixels)
    return LearnedChain().segment(run, DEFAULT_CATALOGUE, {}, Silent()).frames


def shares_found(frames: tuple[FrameChains, ...], simulated: SimulatedRun) -> tuple[float, int]:
    """Return the share of electrodes found within 3 px.

    The second number counts electrodes of chains elsewhere.
    """
    right = there = false = 0
    for entry in frames:
        true = np.concatenate([uv[entry.frame] for uv in simulated.truth.pixels_uv.values()])
        seen = np.concatenate([np.zeros((0, 2)), *(chain.pixels_uv for chain in entry.chains)])
        away = np.linalg.norm(seen[:, None] - true[None], axis=2)
        right += int((away.min(axis=0, initial=np.inf) < 3.0).sum())
        false += int((away.min(axis=1, initial=np.inf) >= 3.0).sum())
        there += len(true)
    return right / there, false


@pytest.mark.parametrize(
    ("relationship", "inverted", "attributes"),
    [
        ("LIN", False, {}),
        ("LIN", True, {"PhotometricInterpretation": "MONOCHROME1"}),
        ("LIN", True, {"PixelIntensityRelationshipSign": -1}),
        ("LIN", False, {"PhotometricInterpretation": "MONOCHROME1", "PixelIntensityRelationshipSign": 1}),
        ("LOG", False, {}),
        ("LOG", True, {"PhotometricInterpretation": "MONOCHROME1"}),
        ("DISP", False, {}),
        ("DISP", True, {}),
        ("DRM", False, {}),
        ("DRM", True, {"PhotometricInterpretation": "MONOCHROME1"}),
        (None, False, {}),
        (None, True, {}),
    ],
)
def test_every_relationship_leads_to_the_same_electrodes(
    make_xa: MakeXa, simulated: SimulatedRun, linear: NDArray[np.uint16], displayed: NDArray[np.uint8],
    relationship: str | None, inverted: bool, attributes: dict[str, Any],
) -> None:  # fmt: skip
    if relationship == "LIN":
        stored: NDArray[Any] = linear
    elif relationship == "LOG":
        stored = np.rint(4095 * np.log1p(linear) / np.log(4096.0)).astype(np.uint16)
    else:
        stored = displayed
    bits = 8 if stored.dtype == np.uint8 else 12
    stored = (2**bits - 1 - stored).astype(stored.dtype) if inverted else stored
    path = make_xa(
        stored, PixelIntensityRelationship=relationship, BitsStored=bits, HighBit=bits - 1, FrameTime=16.7, **attributes
    )
    facts = read_instance(path)
    assert facts.pixels.logarithmic == (relationship != "LIN")
    assert (HeaderWarning.PIXEL_INTENSITY_UNKNOWN in facts.warnings) == (relationship is None)
    found, false = shares_found(segmented(path), simulated)
    assert found >= 0.9
    assert false == 0


def test_a_compressed_picture_whose_header_says_nothing_of_inversion(
    make_xa: MakeXa, simulated: SimulatedRun, displayed: NDArray[np.uint8]
) -> None:
    fragments = []
    for frame in 255 - displayed:
        stored = io.BytesIO()
        Image.fromarray(frame).save(stored, "JPEG", quality=85)
        fragments.append(stored.getvalue() + b"\0" * (stored.tell() % 2))
    path = make_xa(
        displayed, syntax="1.2.840.10008.1.2.4.50", fragments=fragments, PixelIntensityRelationship=None, FrameTime=16.7
    )
    found, false = shares_found(segmented(path), simulated)
    assert found >= 0.9
    assert false == 0
