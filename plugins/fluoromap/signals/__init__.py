"""Signals of an EP recorder: recordings with many channels and beats."""

from fluoromap.signals.formats import FORMATS, read_recording
from fluoromap.signals.recording import Channel, ChannelKind, NotARecording, Recording

__all__ = ["FORMATS", "Channel", "ChannelKind", "NotARecording", "Recording", "read_recording"]
