"""Plain names: corrections and snapshots; results in binary form; columns that nothing read are gone."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.drop_index("ix_mark_study_id", table_name="mark")
    op.rename_table("mark", "correction")
    with op.batch_alter_table("correction") as table:
        table.drop_constraint("uq_mark_version", type_="unique")
        table.create_unique_constraint("uq_correction_version", ["study_id", "sop_instance_uid", "frame", "version"])
        table.create_index("ix_correction_study_id", ["study_id"])
    with op.batch_alter_table("job") as table:
        table.alter_column("manifest", new_column_name="snapshot")
    with op.batch_alter_table("study") as table:
        table.drop_column("frame_of_reference_uid")
    _keep_chosen_pairs_only()
    with op.batch_alter_table("site") as table:
        table.drop_column("electrogram")
        table.alter_column("paired_a", new_column_name="ordered_a")
        table.alter_column("paired_b", new_column_name="ordered_b")
    with op.batch_alter_table("study_instance") as table:
        table.drop_column("added")
    with op.batch_alter_table("file") as table:
        table.drop_column("size")
        table.drop_column("media_type")
        table.drop_column("created")
    with op.batch_alter_table("instance") as table:
        table.drop_column("series_number")
        table.drop_column("acquired")
        table.drop_column("created")
    for name in ("stage_result", "event"):
        with op.batch_alter_table(name) as table:
            table.drop_column("created")
    _rename_corrections()
    # Results were JSON and are MessagePack now: a new job computes them again.
    op.execute("DELETE FROM stage_result")
    op.execute("UPDATE stage SET result = NULL")


def _keep_chosen_pairs_only() -> None:
    """Remove the names that the service gave to pairs by time.

    A name stays when a person gave such a site a time.
    """
    by_time = "paired_a IS NOT NULL AND csv_row IS NULL AND explicit_a IS NULL AND explicit_b IS NULL"
    op.execute(f"DELETE FROM site WHERE {by_time} AND lat_ms IS NULL")
    op.execute(f"UPDATE site SET explicit_a = paired_a, explicit_b = paired_b WHERE {by_time}")


def _rename_corrections() -> None:
    connection = op.get_bind()
    job = sa.table("job", sa.column("id", sa.String), sa.column("snapshot", sa.JSON))
    for job_id, snapshot in connection.execute(sa.select(job.c.id, job.c.snapshot)).all():
        for run in snapshot["runs"].values():
            run["corrections"] = run.pop("marks", {})
        connection.execute(job.update().where(job.c.id == job_id).values(snapshot=snapshot))
