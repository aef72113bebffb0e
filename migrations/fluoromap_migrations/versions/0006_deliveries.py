"""Deliveries of results."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "delivery_target",
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("kind", sa.String(10), nullable=False),
        sa.Column("since", sa.Float(53), nullable=False),
        sa.PrimaryKeyConstraint("name", name="pk_delivery_target"),
    )
    op.create_table(
        "delivery",
        sa.Column("id", sa.String(32), nullable=False),
        sa.Column("target", sa.String(64), nullable=False),
        sa.Column("job_id", sa.String(32), nullable=False),
        sa.Column("state", sa.String(10), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("failures", sa.Integer(), nullable=False),
        sa.Column("since", sa.Float(53), nullable=False),
        sa.Column("due", sa.Float(53), nullable=False),
        sa.Column("lease_until", sa.Float(53), nullable=True),
        sa.Column("sender", sa.String(100), nullable=True),
        sa.Column("error", sa.JSON(), nullable=True),
        sa.Column("created", sa.Float(53), nullable=False),
        sa.Column("finished", sa.Float(53), nullable=True),
        sa.PrimaryKeyConstraint("id", name="pk_delivery"),
        sa.ForeignKeyConstraint(["target"], ["delivery_target.name"], name="fk_delivery_target_delivery_target"),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name="fk_delivery_job_id_job", ondelete="CASCADE"),
        sa.UniqueConstraint("target", "job_id", name="uq_delivery"),
    )
    op.create_index("ix_delivery_state_target", "delivery", ["state", "target"])
    op.create_index("ix_delivery_created_id", "delivery", ["created", "id"])
    op.create_index("ix_delivery_job_id", "delivery", ["job_id"])
    _create_part(
        "delivery_object",
        sa.Column("sop_instance_uid", sa.String(64), nullable=False),
        sa.Column("name", sa.String(64), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("state", sa.String(10), nullable=False),
        sa.Column("delivered", sa.Float(53), nullable=True),
        sa.UniqueConstraint("delivery_id", "sop_instance_uid", name="uq_delivery_object"),
    )
    _create_part(
        "delivery_attempt",
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("ended", sa.Float(53), nullable=False),
        sa.Column("code", sa.String(40), nullable=True),
        sa.Column("detail", sa.Text(), nullable=True),
    )
    op.create_index("ix_delivery_attempt_delivery_id", "delivery_attempt", ["delivery_id"])
    op.create_index("ix_job_finished", "job", ["finished"])


def _create_part(name: str, *columns: sa.schema.SchemaItem) -> None:
    op.create_table(
        name,
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("delivery_id", sa.String(32), nullable=False),
        *columns,
        sa.PrimaryKeyConstraint("id", name=f"pk_{name}"),
        sa.ForeignKeyConstraint(
            ["delivery_id"], ["delivery.id"], name=f"fk_{name}_delivery_id_delivery", ondelete="CASCADE"
        ),
    )
