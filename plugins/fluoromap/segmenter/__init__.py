"""The segmenters: chains of electrodes in the frames of one run.

The rooms, each of which imports only those after it:

- ``four_step``, ``catheter_chain``, ``learned_chain``: the plugins, and what only one of them has.
- ``runs``: the steps of a run, and its hypotheses: other scales, absent and unlisted catheters.
- ``frames``: the search of one frame. ``tracks``: the chains of one catheter along a run.
- ``places``: fits of electrodes to the picture, and the ellipse of each place.
- ``judge``: the only place that says "this is a catheter", and which.
- ``chains``: candidate electrodes are linked and completed.
- ``electrodes``: proposers of single electrodes, blobs and network. ``shape``: rows, loops, spacings.
- ``picture``: field, log image, lag, motion, means of frames.
"""
