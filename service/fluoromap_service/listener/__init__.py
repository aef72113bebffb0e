"""The DICOM listener: C-ECHO and C-STORE for the senders of an allow-list."""
