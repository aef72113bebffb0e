"""Names of channels as laboratories write them."""

import pytest

from fluoromap.signals import Channel, ChannelKind
from fluoromap.signals.channel_names import described

B, U, S = ChannelKind.BIPOLAR, ChannelKind.UNIPOLAR, ChannelKind.SURFACE


@pytest.mark.parametrize(
    ("name", "kind", "catheter", "electrodes", "position"),
    [
        ("CS 1-2", B, "CS", (1, 2), None),
        ("CS 9,10", B, "CS", (9, 10), None),
        ("CS9-CS10", B, "CS", (9, 10), None),
        ("HIS d", B, "HIS", (), "d"),
        ("HIS m", B, "HIS", (), "m"),
        ("HISp", B, "HIS", (), "p"),
        ("ABL d", B, "ABL", (), "d"),
        ("ABL 1-2", B, "ABL", (1, 2), None),
        ("Abl dist", B, "Abl", (), "d"),
        ("MAP 3-4", B, "MAP", (3, 4), None),
        ("RVa", B, "RVa", (), None),
        ("RV 1-2", B, "RV", (1, 2), None),
        ("20A 1-2", B, "20A", (1, 2), None),
        ("UNI 1", U, None, (1,), None),
        ("A1", U, "A", (1,), None),
        ("M1", U, "M", (1,), None),
        ("I", S, None, (), None),
        ("aVF", S, None, (), None),
        ("V1", S, None, (), None),
        ("V6", S, None, (), None),
        ("ECG II", S, None, (), None),
        ("Stim 1", ChannelKind.STIMULUS, None, (), None),
        ("STIM", ChannelKind.STIMULUS, None, (), None),
        ("ABP", ChannelKind.OTHER, None, (), None),
        ("P1", ChannelKind.OTHER, None, (), None),
        ("something else entirely", ChannelKind.OTHER, None, (), None),
    ],
)
def test_the_name_of_a_channel(
    name: str, kind: ChannelKind, catheter: str | None, electrodes: tuple[int, ...], position: str | None
) -> None:
    found = described(Channel(name, 1000.0, "mV", ChannelKind.OTHER))
    assert (found.kind, found.catheter, found.electrodes, found.position) == (kind, catheter, electrodes, position)
    assert found.name == name
