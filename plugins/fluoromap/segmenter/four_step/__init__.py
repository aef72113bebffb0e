"""Segmenter ``four-step``: the filters of the paper, equations (4) to (7)."""
