"""Shapes of catheters in a picture: rows, loops, spacings, bends, and how two chains compare."""
