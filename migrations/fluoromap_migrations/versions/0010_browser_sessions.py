"""Sessions of browsers with ids of their own, and failed sign-ins, which all parts of the service share."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "browser_session",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("token_id", sa.Integer(), nullable=False),
        sa.Column("opened", sa.Float(53), nullable=True),
        sa.Column("expires", sa.Float(53), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_browser_session"),
        sa.ForeignKeyConstraint(
            ["token_id"], ["token.id"], name="fk_browser_session_token_id_token", ondelete="CASCADE"
        ),
        sa.UniqueConstraint("sha256", name="uq_browser_session_sha256"),
    )
    op.create_index("ix_browser_session_token_id", "browser_session", ["token_id"])
    op.create_table(
        "sign_in_failure",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("address", sa.String(64), nullable=False),
        sa.Column("at", sa.Float(53), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_sign_in_failure"),
    )
    op.create_index("ix_sign_in_failure_address_at", "sign_in_failure", ["address", "at"])
    op.create_index("ix_sign_in_failure_at", "sign_in_failure", ["at"])
