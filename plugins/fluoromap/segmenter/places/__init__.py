"""Places of electrodes: bands and cylinders are fitted to the picture, and each place gets its ellipse."""
