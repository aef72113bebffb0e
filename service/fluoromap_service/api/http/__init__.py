"""What every route shares: problems, paging, entity tags, idempotency, access."""
