"""The headers of all objects and their values, so that a DICOMweb search reads no file.

The service fills these tables for the runs that are stored already: in the background, and before a search that needs them.
"""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None

CODE_POINTS = sa.Text().with_variant(sa.Text(collation="C"), "postgresql")


def upgrade() -> None:
    op.add_column("instance", sa.Column("is_indexed", sa.Boolean(), server_default=sa.false(), nullable=False))
    op.create_index("ix_instance_is_indexed", "instance", ["is_indexed"])
    op.create_table(
        "dicom_object",
        sa.Column("id", sa.Integer(), primary_key=True),
        sa.Column("uid", CODE_POINTS, nullable=False),
        sa.Column("study_uid", CODE_POINTS, nullable=False),
        sa.Column("series_uid", CODE_POINTS, nullable=False),
        sa.Column("modality", CODE_POINTS, nullable=True),
        sa.Column("sop_class_uid", CODE_POINTS, nullable=True),
        sa.Column("run", sa.String(64), sa.ForeignKey("instance.sop_instance_uid", ondelete="CASCADE"), nullable=True),
        sa.Column("job_id", sa.String(32), sa.ForeignKey("job.id", ondelete="CASCADE"), nullable=True),
        sa.Column("name", sa.String(64), nullable=True),
        sa.Column("header", sa.Text(), nullable=False),
        sa.Column("is_whole", sa.Boolean(), nullable=False),
        sa.Column("unreadable", sa.Integer(), nullable=False),
        sa.UniqueConstraint("uid", name="uq_dicom_object_uid"),
        sa.UniqueConstraint("run", name="uq_dicom_object_run"),
    )
    op.create_index(
        "ix_dicom_object_place", "dicom_object", ["study_uid", "series_uid", "uid", "modality", "sop_class_uid"]
    )
    op.create_index("ix_dicom_object_job_id", "dicom_object", ["job_id"])
    op.create_table(
        "dicom_value",
        sa.Column("id", sa.Integer(), primary_key=True),
        sa.Column("object_id", sa.Integer(), sa.ForeignKey("dicom_object.id", ondelete="CASCADE"), nullable=False),
        sa.Column("path", CODE_POINTS, nullable=False),
        sa.Column("item", sa.Integer(), nullable=False),
        sa.Column("first", CODE_POINTS, nullable=True),
        sa.Column("last", CODE_POINTS, nullable=True),
    )
    op.create_index("ix_dicom_value_object_id", "dicom_value", ["object_id"])
    op.create_index("ix_dicom_value_path_first", "dicom_value", ["path", "first", "last", "object_id", "item"])
