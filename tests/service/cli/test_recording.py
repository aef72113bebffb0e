"""``fluoromap recording`` lists the channels of an export, and names what is wrong."""

from pathlib import Path

from program import Program, one_sentence

EXPORT = (
    "[Header]\r\nChannels exported: 2\r\nSamples per channel: 2\r\nStart time: 10:11:12\r\nSample Rate: 1000Hz\r\n"
    "Channel #: 1\r\nLabel: II\r\nRange: 5mv\r\nLow: 30Hz\r\nHigh: 250Hz\r\n"
    "Channel #: 2\r\nLabel: CS 1-2\r\nRange: 5mv\r\n[Data]\r\n16384,1\r\n-16384,2\r\n"
)


def test_the_channels_are_listed(fluoromap: Program, tmp_path: Path) -> None:
    (tmp_path / "exports").mkdir()
    (tmp_path / "exports" / "export.txt").write_text(EXPORT, newline="")
    answer = fluoromap("recording", "exports")
    assert answer.returncode == 0
    assert "LabSystem Pro, 2 channels, 0.002 s, began 10:11:12" in answer.stdout
    assert "-2.500 to 2.500 mV" in answer.stdout


def test_a_damaged_line_is_named(fluoromap: Program, tmp_path: Path) -> None:
    (tmp_path / "export.txt").write_text(EXPORT.replace("-16384,2", "-16384"), newline="")
    assert "Line 16 has 1 samples" in one_sentence(fluoromap("recording", "export.txt"))
