"""Single electrodes: what proposers say about one picture, blobs and network."""
