"""The segmenters: chains of electrodes in the frames of one run.

Every built-in plugin has a folder of its own. The modules beside the folders are shared: ``run_segmentation`` walks
through a run and calls the plugin's detector, ``linking`` builds chains from candidate electrodes, ``tracking`` numbers
the catheters.
"""
