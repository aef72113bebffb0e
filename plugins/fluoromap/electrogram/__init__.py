"""Activation times from electrograms."""

from fluoromap.electrogram.activation import ElectrogramResult, UnusableElectrogram, activation_time

__all__ = ["ElectrogramResult", "UnusableElectrogram", "activation_time"]
