"""Rules on what was uploaded: pairing runs into sites, corrections, the snapshot that a job works from."""
