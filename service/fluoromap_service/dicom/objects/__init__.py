"""Results as DICOM objects: structured report, secondary capture of the overlays, encapsulated STL."""
