"""The REST doors: one router a resource."""
