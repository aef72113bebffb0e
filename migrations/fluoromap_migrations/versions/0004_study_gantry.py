"""Gantry values of a whole study, for headers that lack them."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    with op.batch_alter_table("study") as table:
        table.add_column(sa.Column("gantry", sa.JSON(), nullable=False, server_default="{}"))
    with op.batch_alter_table("study") as table:
        table.alter_column("gantry", server_default=None)
