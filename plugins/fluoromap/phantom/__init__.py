"""Phantom: a beating heart with catheters, rendered as fluoroscopy, with its truth."""

from fluoromap.phantom.appearance import APPEARANCES, Appearance, Contrast
from fluoromap.phantom.chamber import Chamber
from fluoromap.phantom.fluoroscopy import RenderedFrames
from fluoromap.phantom.motion import HeartKind
from fluoromap.phantom.simulated_study import (
    FRONTAL,
    LATERAL,
    RunTruth,
    SimulatedRun,
    SimulatedSite,
    SimulatedStudy,
    SiteTruth,
    StudySpec,
    simulate_study,
)

__all__ = [
    "APPEARANCES",
    "FRONTAL",
    "LATERAL",
    "Appearance",
    "Chamber",
    "Contrast",
    "HeartKind",
    "RenderedFrames",
    "RunTruth",
    "SimulatedRun",
    "SimulatedSite",
    "SimulatedStudy",
    "SiteTruth",
    "StudySpec",
    "simulate_study",
]
