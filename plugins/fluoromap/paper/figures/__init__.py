"""The paper's Figures 3, 4 and 5 on a simulated study: the map from exact depth and from single-view depth."""

from fluoromap.paper.figures.paper_figures import PaperFigures, paper_figures

__all__ = ["PaperFigures", "paper_figures"]
