"""What the name of a channel says: surface lead, stimulus, or catheter and electrodes."""

from __future__ import annotations

import re
from dataclasses import replace

from fluoromap.signals.recording import Channel, ChannelKind

_SURFACE = re.compile(r"(?:ECG[\s_-]*)?(I|II|III|aVR|aVL|aVF|V[1-9]R?|VCG|X|Y|Z|MCL\d?)", re.IGNORECASE)
_STIMULUS = re.compile(r"(?:S|P)?(?:TIM|TIMULUS|TIMULATION|ACE|ACING)[\s_.-]*(?:CH)?\s*\d*", re.IGNORECASE)
_OTHER = re.compile(
    r"(?:ABP|ART|NIBP|SPO2|RESP|PLETH|P[1-4]|FORCE|TEMP|IMP(?:EDANCE)?|POWER|TIME|TRIG(?:GER)?)\d*", re.IGNORECASE
)
_UNIPOLAR = re.compile(r"(?:UNI|UP|U)(?:POLAR)?[\s_-]*(?P<electrode>\d{1,2})", re.IGNORECASE)
_PAIR = re.compile(r"(?P<catheter>.*?)[\s_]*(?P<first>\d{1,2})\s*[-,/:]\s*(?:[A-Za-z]{1,3})?(?P<second>\d{1,2})")
_PLACE = re.compile(r"(?P<catheter>.+?)[\s_-]*(?P<place>dist(?:al)?|prox(?:imal)?|mid(?:dle)?|d|m|p)", re.IGNORECASE)
_SINGLE = re.compile(r"(?P<catheter>[A-Za-z][A-Za-z ]*?)[\s_-]*(?P<electrode>\d{1,2})")
_ONE_WORD_CATHETERS = re.compile(r"(?:H?RA|RVA?|HIS|HBE|LV|LA|CS|ABL|MAP|LASSO|ROV|PV|HALO)[a-z]?", re.IGNORECASE)


def described(channel: Channel) -> Channel:
    """Return a channel with kind, catheter and electrodes as its name gives them.

    Surface leads are never catheters. ``CS 1-2`` and ``CS 1,2`` are a pair, ``UNI 1`` and ``A1`` single electrodes, ``HIS d`` the
    pair at the tip. Names that follow no rule are kind ``other`` without a catheter; people set them by hand.
    """
    name = " ".join(channel.name.split())
    if _SURFACE.fullmatch(name):
        return replace(channel, kind=ChannelKind.SURFACE)
    if _STIMULUS.fullmatch(name):
        return replace(channel, kind=ChannelKind.STIMULUS)
    if _OTHER.fullmatch(name):
        return replace(channel, kind=ChannelKind.OTHER)
    if found := _UNIPOLAR.fullmatch(name):
        return replace(channel, kind=ChannelKind.UNIPOLAR, electrodes=(int(found["electrode"]),))
    if found := _PAIR.fullmatch(name):
        catheter = found["catheter"].strip(" -_") or None
        pair = int(found["first"]), int(found["second"])
        return replace(channel, kind=ChannelKind.BIPOLAR, catheter=catheter, electrodes=pair)
    found = _PLACE.fullmatch(name)
    if found and (_ONE_WORD_CATHETERS.fullmatch(found["catheter"]) or " " in name or len(found["place"]) > 1):
        place = found["place"][0].lower()
        return replace(channel, kind=ChannelKind.BIPOLAR, catheter=found["catheter"].strip(), position=place)
    if found := _SINGLE.fullmatch(name):
        return replace(
            channel,
            kind=ChannelKind.UNIPOLAR,
            catheter=found["catheter"].strip(),
            electrodes=(int(found["electrode"]),),
        )
    if _ONE_WORD_CATHETERS.fullmatch(name):
        return replace(channel, kind=ChannelKind.BIPOLAR, catheter=name)
    return replace(channel, kind=ChannelKind.OTHER)
