"""The command ``fluoromap dicom-listener``: when it refuses to start."""

from __future__ import annotations

from program import Program, one_sentence


def test_other_machines_need_an_allow_list(fluoromap: Program) -> None:
    assert "--allow AET" in one_sentence(fluoromap("dicom-listener", "--host", "0.0.0.0"))


def test_unusable_sender(fluoromap: Program) -> None:
    assert "not usable" in one_sentence(fluoromap("dicom-listener", "--allow", "XA1@room"))
