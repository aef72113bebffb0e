"""From the frames of one run to chains of electrodes: the first stage. One file a step, one file a built-in plugin."""
