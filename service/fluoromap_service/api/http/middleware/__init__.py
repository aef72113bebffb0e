"""Layers around every route: headers, log, audit trail, free space, request bodies."""
