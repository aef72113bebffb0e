"""The sender: it takes deliveries from the outbox and sends them to their targets."""
