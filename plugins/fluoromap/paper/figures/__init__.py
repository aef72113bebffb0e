"""The paper's Figures 3, 4 and 5: maps of a simulated study from exact and single-view depth."""

from fluoromap.paper.figures.paper_figures import PaperFigures, paper_figures

__all__ = ["PaperFigures", "paper_figures"]
