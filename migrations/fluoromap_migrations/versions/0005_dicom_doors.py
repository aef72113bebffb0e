"""The DICOM study of a mapping study that a DICOM door made."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    with op.batch_alter_table("study") as table:
        table.add_column(sa.Column("study_instance_uid", sa.String(64), nullable=True))
        table.create_index("ix_study_study_instance_uid", ["study_instance_uid"])
