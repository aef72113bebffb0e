"""Studies without a reference catheter."""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    with op.batch_alter_table("study") as table:
        table.alter_column("reference", existing_type=sa.String(64), nullable=True)
