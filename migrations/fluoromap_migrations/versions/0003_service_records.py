"""Audit trail; sums for the metrics; answers that go with their study; indices for pages of long lists."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "audit",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("at", sa.Float(53), nullable=False),
        sa.Column("who", sa.String(100), nullable=False),
        sa.Column("what", sa.String(200), nullable=False),
        sa.Column("study", sa.String(32), nullable=True),
        sa.Column("job", sa.String(32), nullable=True),
        sa.Column("status", sa.Integer(), nullable=True),
        sa.Column("hash", sa.String(64), nullable=False),
        sa.PrimaryKeyConstraint("id", name="pk_audit"),
    )
    op.create_index("ix_audit_study", "audit", ["study"])
    _make_append_only()
    op.create_table(
        "tally",
        sa.Column("name", sa.String(100), nullable=False),
        sa.Column("value", sa.Float(53), nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_tally"),
    )
    # Stored answers do not name their study yet, and they are repeated for 24 hours only.
    op.execute("DELETE FROM idempotency")
    with op.batch_alter_table("idempotency") as table:
        table.add_column(sa.Column("study_id", sa.String(32), nullable=True))
        table.create_foreign_key("fk_idempotency_study_id_study", "study", ["study_id"], ["id"], ondelete="CASCADE")
        table.create_index("ix_idempotency_study_id", ["study_id"])
    with op.batch_alter_table("stage") as table:
        table.add_column(sa.Column("ready_since", sa.Float(53), nullable=True))
        table.add_column(sa.Column("started", sa.Float(53), nullable=True))
    with op.batch_alter_table("job") as table:
        table.drop_index("ix_job_created")
        table.drop_index("ix_job_study_id")
        table.create_index("ix_job_created_id", ["created", "id"])
        table.create_index("ix_job_study_created_id", ["study_id", "created", "id"])
    with op.batch_alter_table("study") as table:
        table.drop_index("ix_study_created")
        table.create_index("ix_study_created_id", ["created", "id"])


def _make_append_only() -> None:
    if op.get_bind().dialect.name == "sqlite":
        for verb in ("UPDATE", "DELETE"):
            op.execute(
                f"CREATE TRIGGER audit_no_{verb} BEFORE {verb} ON audit "
                "BEGIN SELECT RAISE(ABORT, 'the audit trail is append-only'); END"
            )
    else:
        op.execute(
            "CREATE FUNCTION audit_append_only() RETURNS trigger LANGUAGE plpgsql AS "
            "$$ BEGIN RAISE EXCEPTION 'the audit trail is append-only'; END $$"
        )
        op.execute(
            "CREATE TRIGGER audit_append_only BEFORE UPDATE OR DELETE OR TRUNCATE ON audit "
            "FOR EACH STATEMENT EXECUTE FUNCTION audit_append_only()"
        )
