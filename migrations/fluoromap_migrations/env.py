"""What Alembic runs for every command: the models' tables against the connection it was handed."""

from __future__ import annotations

from alembic import context

from fluoromap_service.store.engine import engine
from fluoromap_service.store.models import Base


def run(connection: object) -> None:
    context.configure(
        connection=connection,  # type: ignore[arg-type]
        target_metadata=Base.metadata,
        # SQLite alters a table by copying it, and undoes a broken migration as a whole.
        render_as_batch=True,
        transactional_ddl=True,
    )
    with context.begin_transaction():
        context.run_migrations()


handed = context.config.attributes.get("connection")
if handed is not None:
    run(handed)
else:
    with engine().connect() as own:
        run(own)
