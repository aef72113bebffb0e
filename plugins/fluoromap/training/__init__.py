"""Training of the electrode network on synthetic fluoroscopy. ``python -m fluoromap.training`` makes the shipped weights.

Only this package needs the optional extra ``training`` (PyTorch). Segmenting needs none of it.
"""
