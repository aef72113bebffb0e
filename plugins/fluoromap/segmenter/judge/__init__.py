"""The only place that says "this is a catheter": features are measured, chains and tracks are accepted and named."""
