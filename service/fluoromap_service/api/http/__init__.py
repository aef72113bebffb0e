"""Parts that every route shares: problems, paging, entity tags, idempotency, access."""
