"""Exports of EP recorders, written here as each recorder writes them, come back with names, rates and millivolts."""

from datetime import datetime, time
from pathlib import Path

import numpy as np
import pytest

from fluoromap.signals import ChannelKind, NotARecording, Recording, read_recording

COUNTS = np.array([[0, 100, -32768], [1, -200, 32767], [2, 300, 5], [-3, 4, 12]])
LABELS = "II", "CS 1-2", "ABL d"


def labsystem(counts: np.ndarray, newline: str = "\r\n", announced: int | None = None) -> bytes:
    lines = [
        "[Header]", f"Channels exported: {len(LABELS)}", f"Samples per channel: {announced or len(counts)}",
        "Start time: 10:11:12", "End time:\t10:11:13", "Sample Rate: 1000Hz", "Data Format 1",
    ]  # fmt: skip
    for number, label in enumerate(LABELS, 1):
        lines += [f"Channel #: {number}", f"Label: {label}", f"Range: {number}mv ", "Low: 30Hz", "High: 250Hz"]
        lines += ["Sample rate: 1000Hz", "Color: 00FF00", "Scale: 2"]
    lines += ["[Data]", *(",".join(map(str, row)) for row in counts)]
    return newline.join([*lines, ""]).encode()


def stored(folder: Path, **files: bytes) -> dict[str, Path]:
    """Store files under names that say nothing.

    The keys are the recorder's names.
    """
    sources = {}
    for number, (name, content) in enumerate(files.items()):
        path = folder / str(number)
        path.write_bytes(content)
        sources[name] = path
    return sources


def matrix(recording: Recording) -> np.ndarray:
    return np.stack(recording.all_samples(), axis=1)


@pytest.mark.parametrize("newline", ["\r\n", "\n"])
def test_labsystem_counts_become_millivolts(tmp_path: Path, newline: str) -> None:
    recording = read_recording(stored(tmp_path, export=labsystem(COUNTS, newline)))
    assert (recording.format, recording.started) == ("LabSystem Pro", time(10, 11, 12))
    assert [channel.name for channel in recording.channels] == list(LABELS)
    assert {channel.rate_hz for channel in recording.channels} == {1000.0}
    assert {(channel.low_hz, channel.high_hz) for channel in recording.channels} == {(30.0, 250.0)}
    np.testing.assert_allclose(matrix(recording), COUNTS * np.array([1.0, 2.0, 3.0]) / 32768, rtol=1e-6)
    assert recording.warnings == ()
    assert recording.duration_ms == 4.0


def test_a_long_export_is_read_in_pieces(tmp_path: Path) -> None:
    counts = np.random.default_rng(1).integers(-30000, 30000, (300_000, 3))
    recording = read_recording(stored(tmp_path, export=labsystem(counts)))
    pieces = list(recording.blocks())
    assert len(pieces) > 1
    joined = np.concatenate([np.stack(piece, axis=1) for piece in pieces])
    np.testing.assert_allclose(joined, counts * np.array([1.0, 2.0, 3.0]) / 32768, rtol=1e-6)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda text: text.replace(b"2,300,5", b"2,300"), "has 2 samples"),
        (lambda text: text.replace(b"2,300,5", b"2,x,5"), "no number"),
        (lambda text: text.replace(b"2,300,5\r\n-3,4,12", b"2,300,5,-3\r\n4,12"), "has 4 samples"),
        (lambda text: text.replace(b"2,300,5", b"2,,5"), "no number"),
        (lambda text: text.replace(b"2,300,5", b"2,nan,5"), "not finite"),
        (lambda text: text.replace(b"2,300,5", b"2,300,5,"), None),
    ],
)
def test_a_damaged_line_is_named(tmp_path: Path, damage: object, words: str | None) -> None:
    content = damage(labsystem(COUNTS))  # type: ignore[operator]
    recording = read_recording(stored(tmp_path, export=content))
    if words is None:
        assert matrix(recording).shape == (4, 3)
        return
    line = content.split(b"[Data]")[0].count(b"\n") + 4
    with pytest.raises(NotARecording, match=f"Line {line} .*{words}"):
        recording.all_samples()


def test_fewer_samples_than_announced_are_told(tmp_path: Path) -> None:
    recording = read_recording(stored(tmp_path, export=labsystem(COUNTS, announced=9)))
    assert recording.warnings == ("The header announces 9 samples for each channel, and the file has 4.",)


def test_a_header_without_data_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NotARecording, match=r"before its line \[Data\]"):
        read_recording(stored(tmp_path, export=labsystem(COUNTS).split(b"[Data]")[0]))


@pytest.mark.parametrize("numbered", [False, True])
def test_cardiolab_columns_follow_the_names_of_the_description(tmp_path: Path, numbered: bool) -> None:
    """The channel numbers skip, and the samples may begin with their own number."""
    description = (
        b"Number of Channel = 3\r\nPoints for Each Channel = 4\r\nData Sampling Rate = 977 points/second\r\n"
        b"Start Time = 6/3/2020 9:12:02 AM\r\nUnits: mmHg for pressure and mV for all others\r\n\r\n"
        b"Channel Number      Channel Label\r\n1  II\r\n49   CS 9,10\r\n75\tABP\r\n"
    )
    values = COUNTS / 1000.0
    rows = "".join(
        (f"{index:8} " if numbered else " ") + "   ".join(f"{value:.3f}" for value in row) + "\r\n"
        for index, row in enumerate(values)
    )
    recording = read_recording(stored(tmp_path, X001_txt=rows.encode(), X001_inf=description))
    assert (recording.format, recording.started) == ("CardioLab", datetime(2020, 6, 3, 9, 12, 2))
    assert [channel.name for channel in recording.channels] == ["II", "CS 9,10", "ABP"]
    assert [channel.unit for channel in recording.channels] == ["mV", "mV", "mmHg"]
    assert recording.channels[1].electrodes == (9, 10)
    np.testing.assert_allclose(matrix(recording), values, rtol=1e-6)


def test_cardiolab_wants_both_files(tmp_path: Path) -> None:
    description = (
        b"Number of Channel = 1\nData Sampling Rate = 1000 points/second\nChannel Number Channel Label\n1 II\n"
    )
    with pytest.raises(NotARecording, match="Send both"):
        read_recording(stored(tmp_path, X001_inf=description))


def test_workmate_files_are_channels(tmp_path: Path) -> None:
    """A header states rate and resolution; a file without one has the recorder's usual ones."""
    names = "II.Session 18 - Page 1.2.TXT", "CS 1-2.Session 18 - Page 1.2.TXT", "Session 18 Information.TXT"
    contents = (
        b"Sample Rate=2000\r\nChannel Resolution=100 nV/LSB\r\n" + b"\r\n".join(b"%d" % n for n in COUNTS[:, 0]),
        b"\n".join(b"%d" % n for n in COUNTS[:, 1]) + b"\n",
        b"Session=18\r\n",
    )
    recording = read_recording(stored(tmp_path, **dict(zip(names, contents, strict=True))))
    assert recording.format == "WorkMate Claris"
    assert [channel.name for channel in recording.channels] == ["CS 1-2", "II"]
    assert {channel.rate_hz for channel in recording.channels} == {2000.0}
    np.testing.assert_allclose(matrix(recording), COUNTS[:, [1, 0]] * np.array([78e-6, 100e-6]), rtol=1e-6)


def test_workmate_pages_do_not_mix(tmp_path: Path) -> None:
    names = "II.Session 18 - Page 1.2.TXT", "CS 1-2.Session 18 - Page 1.3.TXT"
    with pytest.raises(NotARecording, match="2 pages"):
        read_recording(stored(tmp_path, **dict.fromkeys(names, b"1\n2\n")))


@pytest.mark.parametrize("comma", [False, True])
def test_ep_tracer_columns_have_units_and_times(tmp_path: Path, comma: bool) -> None:
    lines = ["TimeOfDay;I[mV];MAP 1-2[uV]"]
    for index, row in enumerate(COUNTS[:, :2]):
        values = [f"{value / 8:.3f}" for value in row]
        lines.append(
            ";".join([f"10:11:12.{5 * index:03d}", *(each.replace(".", ",") if comma else each for each in values)])
        )
    recording = read_recording(stored(tmp_path, export="\r\n".join([*lines, ""]).encode()))
    assert (recording.format, recording.started) == ("EP-Tracer", time(10, 11, 12))
    assert [(channel.name, channel.unit, channel.rate_hz) for channel in recording.channels] == [
        ("I", "mV", 200.0), ("MAP 1-2", "mV", 200.0),
    ]  # fmt: skip
    np.testing.assert_allclose(matrix(recording), COUNTS[:, :2] / 8 * np.array([1.0, 1e-3]), rtol=1e-6)


def test_carto_counts_have_the_gain_of_the_export(tmp_path: Path) -> None:
    export = (
        "ECG_Export_4.0\nRaw ECG to MV (gain) = 0.003000\n"
        "Unipolar Mapping Channel=M1 Bipolar Mapping Channel=M1-M2 Reference Channel=CS9-CS10\n"
        "M1(1)    M1-M2(33)   CS9-CS10(71)\n" + "\n".join("".join(f"{value:12d}" for value in row) for row in COUNTS)
    ).encode()
    recording = read_recording(stored(tmp_path, export=export))
    assert [channel.name for channel in recording.channels] == ["M1", "M1-M2", "CS9-CS10"]
    assert [channel.kind for channel in recording.channels] == [
        ChannelKind.UNIPOLAR, ChannelKind.BIPOLAR, ChannelKind.BIPOLAR,
    ]  # fmt: skip
    assert recording.channels[2].electrodes == (9, 10)
    np.testing.assert_allclose(matrix(recording), COUNTS * 0.003, rtol=1e-6)


@pytest.mark.parametrize("content", [b"", b"time_ms;a;b\n", b"\x89PNG\r\n\x1a\n" + bytes(100)])
def test_other_files_are_refused_with_the_known_recorders(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(NotARecording, match="LabSystem Pro, CARTO 3"):
        read_recording(stored(tmp_path, export=content))
