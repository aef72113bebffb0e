"""The first tables."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.create_table(
        "file",
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("size", sa.BigInteger(), nullable=False),
        sa.Column("media_type", sa.String(length=100), nullable=False),
        sa.Column("created", sa.Float(precision=53), nullable=False),
        sa.PrimaryKeyConstraint("sha256", name=op.f("pk_file")),
    )
    op.create_table(
        "idempotency",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("key", sa.String(length=64), nullable=False),
        sa.Column("request_sha256", sa.String(length=64), nullable=False),
        sa.Column("status", sa.Integer(), nullable=True),
        sa.Column("headers", sa.JSON(), nullable=True),
        sa.Column("body", sa.Text(), nullable=True),
        sa.Column("created", sa.Float(precision=53), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_idempotency")),
        sa.UniqueConstraint("key", name=op.f("uq_idempotency_key")),
    )
    op.create_index(op.f("ix_idempotency_created"), "idempotency", ["created"], unique=False)
    op.create_table(
        "study",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("label", sa.String(length=200), nullable=False),
        sa.Column("chamber", sa.String(length=100), nullable=True),
        sa.Column("notes", sa.Text(), nullable=True),
        sa.Column("catheters", sa.JSON(), nullable=False),
        sa.Column("reference", sa.String(length=64), nullable=False),
        sa.Column("mapping", sa.String(length=64), nullable=False),
        sa.Column("frame_of_reference_uid", sa.String(length=64), nullable=False),
        sa.Column("created", sa.Float(precision=53), nullable=False),
        sa.Column("updated", sa.Float(precision=53), nullable=False),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_study")),
    )
    op.create_index(op.f("ix_study_created"), "study", ["created"], unique=False)
    op.create_table(
        "token",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("scopes", sa.JSON(), nullable=False),
        sa.Column("created", sa.Float(precision=53), nullable=False),
        sa.Column("expires", sa.Float(precision=53), nullable=True),
        sa.Column("revoked", sa.Float(precision=53), nullable=True),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_token")),
        sa.UniqueConstraint("name", name=op.f("uq_token_name")),
        sa.UniqueConstraint("sha256", name=op.f("uq_token_sha256")),
    )
    op.create_table(
        "worker_seen",
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("seen", sa.Float(precision=53), nullable=False),
        sa.PrimaryKeyConstraint("name", name=op.f("pk_worker_seen")),
    )
    op.create_table(
        "instance",
        sa.Column("sop_instance_uid", sa.String(length=64), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("study_instance_uid", sa.String(length=64), nullable=False),
        sa.Column("series_instance_uid", sa.String(length=64), nullable=False),
        sa.Column("series_number", sa.Integer(), nullable=True),
        sa.Column("acquired", sa.String(length=40), nullable=True),
        sa.Column("facts", sa.JSON(), nullable=False),
        sa.Column("created", sa.Float(precision=53), nullable=False),
        sa.ForeignKeyConstraint(["sha256"], ["file.sha256"], name=op.f("fk_instance_sha256_file")),
        sa.PrimaryKeyConstraint("sop_instance_uid", name=op.f("pk_instance")),
    )
    op.create_index(op.f("ix_instance_sha256"), "instance", ["sha256"], unique=False)
    op.create_index(op.f("ix_instance_study_instance_uid"), "instance", ["study_instance_uid"], unique=False)
    op.create_table(
        "job",
        sa.Column("id", sa.String(length=32), nullable=False),
        sa.Column("study_id", sa.String(length=32), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("manifest", sa.JSON(), nullable=False),
        sa.Column("cancel_requested", sa.Boolean(), nullable=False),
        sa.Column("error", sa.JSON(), nullable=True),
        sa.Column("created", sa.Float(precision=53), nullable=False),
        sa.Column("started", sa.Float(precision=53), nullable=True),
        sa.Column("finished", sa.Float(precision=53), nullable=True),
        sa.ForeignKeyConstraint(["study_id"], ["study.id"], name=op.f("fk_job_study_id_study"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_job")),
    )
    op.create_index(op.f("ix_job_created"), "job", ["created"], unique=False)
    op.create_index(op.f("ix_job_state"), "job", ["state"], unique=False)
    op.create_index(op.f("ix_job_study_id"), "job", ["study_id"], unique=False)
    op.create_table(
        "mark",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("study_id", sa.String(length=32), nullable=False),
        sa.Column("sop_instance_uid", sa.String(length=64), nullable=False),
        sa.Column("frame", sa.Integer(), nullable=False),
        sa.Column("version", sa.Integer(), nullable=False),
        sa.Column("electrodes", sa.JSON(), nullable=True),
        sa.Column("author", sa.String(length=100), nullable=False),
        sa.Column("created", sa.Float(precision=53), nullable=False),
        sa.ForeignKeyConstraint(["study_id"], ["study.id"], name=op.f("fk_mark_study_id_study"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_mark")),
        sa.UniqueConstraint("study_id", "sop_instance_uid", "frame", "version", name="uq_mark_version"),
    )
    op.create_index(op.f("ix_mark_study_id"), "mark", ["study_id"], unique=False)
    op.create_table(
        "site",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("study_id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=64), nullable=False),
        sa.Column("lat_ms", sa.Float(precision=53), nullable=True),
        sa.Column("lat_sd_ms", sa.Float(precision=53), nullable=True),
        sa.Column("lat_by", sa.String(length=12), nullable=True),
        sa.Column("csv_row", sa.Integer(), nullable=True),
        sa.Column("explicit_a", sa.String(length=64), nullable=True),
        sa.Column("explicit_b", sa.String(length=64), nullable=True),
        sa.Column("csv_a", sa.Text(), nullable=True),
        sa.Column("csv_b", sa.Text(), nullable=True),
        sa.Column("paired_a", sa.String(length=64), nullable=True),
        sa.Column("paired_b", sa.String(length=64), nullable=True),
        sa.Column("electrogram", sa.JSON(), nullable=True),
        sa.ForeignKeyConstraint(["study_id"], ["study.id"], name=op.f("fk_site_study_id_study"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_site")),
        sa.UniqueConstraint("study_id", "name", name="uq_site_name"),
    )
    op.create_index(op.f("ix_site_study_id"), "site", ["study_id"], unique=False)
    op.create_table(
        "stage_result",
        sa.Column("key", sa.String(length=64), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.Column("created", sa.Float(precision=53), nullable=False),
        sa.ForeignKeyConstraint(["sha256"], ["file.sha256"], name=op.f("fk_stage_result_sha256_file")),
        sa.PrimaryKeyConstraint("key", name=op.f("pk_stage_result")),
    )
    op.create_index(op.f("ix_stage_result_sha256"), "stage_result", ["sha256"], unique=False)
    op.create_table(
        "event",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.String(length=32), nullable=False),
        sa.Column("kind", sa.String(length=10), nullable=False),
        sa.Column("data", sa.JSON(), nullable=False),
        sa.Column("created", sa.Float(precision=53), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_event_job_id_job"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_event")),
    )
    op.create_index(op.f("ix_event_job_id"), "event", ["job_id"], unique=False)
    op.create_table(
        "point",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.String(length=32), nullable=False),
        sa.Column("site", sa.String(length=64), nullable=False),
        sa.Column("catheter", sa.String(length=64), nullable=False),
        sa.Column("electrode", sa.Integer(), nullable=False),
        sa.Column("position_mm", sa.JSON(), nullable=True),
        sa.Column("covariance_mm2", sa.JSON(), nullable=True),
        sa.Column("relative_mm", sa.JSON(), nullable=True),
        sa.Column("relative_covariance_mm2", sa.JSON(), nullable=True),
        sa.Column("view_a", sa.String(length=64), nullable=True),
        sa.Column("view_b", sa.String(length=64), nullable=True),
        sa.Column("frame_a", sa.Integer(), nullable=True),
        sa.Column("frame_b", sa.Integer(), nullable=True),
        sa.Column("residual_a_px", sa.Float(precision=53), nullable=True),
        sa.Column("residual_b_px", sa.Float(precision=53), nullable=True),
        sa.Column("ray_angle_deg", sa.Float(precision=53), nullable=True),
        sa.Column("lat_ms", sa.Float(precision=53), nullable=True),
        sa.Column("grade", sa.String(length=10), nullable=False),
        sa.Column("relative_grade", sa.String(length=10), nullable=False),
        sa.Column("reasons", sa.JSON(), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_point_job_id_job"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_point")),
        sa.UniqueConstraint("job_id", "site", "catheter", "electrode", name="uq_point"),
    )
    op.create_index(op.f("ix_point_job_id"), "point", ["job_id"], unique=False)
    op.create_table(
        "rendering",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.String(length=32), nullable=False),
        sa.Column("key", sa.String(length=64), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=False),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_rendering_job_id_job"), ondelete="CASCADE"),
        sa.ForeignKeyConstraint(["sha256"], ["file.sha256"], name=op.f("fk_rendering_sha256_file")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_rendering")),
        sa.UniqueConstraint("key", name=op.f("uq_rendering_key")),
    )
    op.create_index(op.f("ix_rendering_job_id"), "rendering", ["job_id"], unique=False)
    op.create_index(op.f("ix_rendering_sha256"), "rendering", ["sha256"], unique=False)
    op.create_table(
        "stage",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("job_id", sa.String(length=32), nullable=False),
        sa.Column("name", sa.String(length=12), nullable=False),
        sa.Column("subject", sa.String(length=64), nullable=False),
        sa.Column("plugin", sa.String(length=100), nullable=False),
        sa.Column("plugin_version", sa.String(length=50), nullable=False),
        sa.Column("depends_on", sa.JSON(), nullable=False),
        sa.Column("state", sa.String(length=10), nullable=False),
        sa.Column("attempt", sa.Integer(), nullable=False),
        sa.Column("lease_until", sa.Float(precision=53), nullable=True),
        sa.Column("worker", sa.String(length=100), nullable=True),
        sa.Column("published", sa.Float(precision=53), nullable=True),
        sa.Column("publications", sa.Integer(), nullable=False),
        sa.Column("progress", sa.Float(precision=53), nullable=False),
        sa.Column("reused", sa.Boolean(), nullable=False),
        sa.Column("result", sa.String(length=64), nullable=True),
        sa.Column("error", sa.JSON(), nullable=True),
        sa.ForeignKeyConstraint(["job_id"], ["job.id"], name=op.f("fk_stage_job_id_job"), ondelete="CASCADE"),
        sa.ForeignKeyConstraint(["result"], ["file.sha256"], name=op.f("fk_stage_result_file")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_stage")),
        sa.UniqueConstraint("job_id", "name", "subject", name="uq_stage"),
    )
    op.create_index(op.f("ix_stage_job_id"), "stage", ["job_id"], unique=False)
    op.create_index(op.f("ix_stage_result"), "stage", ["result"], unique=False)
    op.create_index("ix_stage_state_published", "stage", ["state", "published"], unique=False)
    op.create_table(
        "study_instance",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("study_id", sa.String(length=32), nullable=False),
        sa.Column("sop_instance_uid", sa.String(length=64), nullable=False),
        sa.Column("file_name", sa.Text(), nullable=True),
        sa.Column("site", sa.String(length=64), nullable=True),
        sa.Column("site_by", sa.String(length=10), nullable=True),
        sa.Column("gantry", sa.JSON(), nullable=False),
        sa.Column("added", sa.Float(precision=53), nullable=False),
        sa.ForeignKeyConstraint(
            ["sop_instance_uid"],
            ["instance.sop_instance_uid"],
            name=op.f("fk_study_instance_sop_instance_uid_instance"),
        ),
        sa.ForeignKeyConstraint(
            ["study_id"], ["study.id"], name=op.f("fk_study_instance_study_id_study"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_study_instance")),
        sa.UniqueConstraint("study_id", "sop_instance_uid", name="uq_study_instance"),
    )
    op.create_index(op.f("ix_study_instance_sop_instance_uid"), "study_instance", ["sop_instance_uid"], unique=False)
    op.create_index(op.f("ix_study_instance_study_id"), "study_instance", ["study_id"], unique=False)


def downgrade() -> None:
    op.drop_index(op.f("ix_study_instance_study_id"), table_name="study_instance")
    op.drop_index(op.f("ix_study_instance_sop_instance_uid"), table_name="study_instance")
    op.drop_table("study_instance")
    op.drop_index("ix_stage_state_published", table_name="stage")
    op.drop_index(op.f("ix_stage_result"), table_name="stage")
    op.drop_index(op.f("ix_stage_job_id"), table_name="stage")
    op.drop_table("stage")
    op.drop_index(op.f("ix_rendering_sha256"), table_name="rendering")
    op.drop_index(op.f("ix_rendering_job_id"), table_name="rendering")
    op.drop_table("rendering")
    op.drop_index(op.f("ix_point_job_id"), table_name="point")
    op.drop_table("point")
    op.drop_index(op.f("ix_event_job_id"), table_name="event")
    op.drop_table("event")
    op.drop_index(op.f("ix_stage_result_sha256"), table_name="stage_result")
    op.drop_table("stage_result")
    op.drop_index(op.f("ix_site_study_id"), table_name="site")
    op.drop_table("site")
    op.drop_index(op.f("ix_mark_study_id"), table_name="mark")
    op.drop_table("mark")
    op.drop_index(op.f("ix_job_study_id"), table_name="job")
    op.drop_index(op.f("ix_job_state"), table_name="job")
    op.drop_index(op.f("ix_job_created"), table_name="job")
    op.drop_table("job")
    op.drop_index(op.f("ix_instance_study_instance_uid"), table_name="instance")
    op.drop_index(op.f("ix_instance_sha256"), table_name="instance")
    op.drop_table("instance")
    op.drop_table("worker_seen")
    op.drop_table("token")
    op.drop_index(op.f("ix_study_created"), table_name="study")
    op.drop_table("study")
    op.drop_index(op.f("ix_idempotency_created"), table_name="idempotency")
    op.drop_table("idempotency")
    op.drop_table("file")
