"""Pictures of the map: overlays on fluoroscopy, the map from six sides, the running activation."""
