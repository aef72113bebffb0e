"""Segmenter ``four-step``: the paper's filters, equations (4) to (7)."""
