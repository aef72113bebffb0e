"""Activation times from electrograms."""

from fluoromap.electrogram.activation import ElectrogramResult, activation_time
from fluoromap.electrogram.recording import UnusableElectrogram

__all__ = ["ElectrogramResult", "UnusableElectrogram", "activation_time"]
