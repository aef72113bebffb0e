"""The science: from fluoroscopy frames to an activation map. Arrays, millimetres and pixels only."""
