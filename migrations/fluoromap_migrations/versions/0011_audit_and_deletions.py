"""How often an act happened; certificates of deletion; size and last use of kept renderings."""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None


def upgrade() -> None:
    # Not in a batch: SQLite would copy the table, and drop the triggers that keep the trail from changes.
    op.add_column("audit", sa.Column("times", sa.Integer(), nullable=True))
    op.create_table(
        "deletion",
        sa.Column("study", sa.String(32), nullable=False),
        sa.Column("at", sa.Float(53), nullable=False),
        sa.Column("certificate", sa.JSON(), nullable=False),
        sa.Column("audit_id", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("study", name="pk_deletion"),
    )
    op.add_column("rendering", sa.Column("bytes", sa.BigInteger(), nullable=True))
    op.add_column("rendering", sa.Column("used", sa.Float(53), nullable=True))
