"""The command ``fluoromap dicom-listener``."""

from __future__ import annotations

from typing import Annotated

import typer

from fluoromap_service import auth, logs
from fluoromap_service.api.http import file_pool
from fluoromap_service.cli.database_failures import explain_database_failures
from fluoromap_service.cli.environment import apply_options, apply_settings, end_with_supervisor
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.options import DataDir
from fluoromap_service.cli.supervisor import stop_on_signals
from fluoromap_service.listener.allow_list import AllowList
from fluoromap_service.listener.tls import server_context
from fluoromap_service.settings import settings
from fluoromap_service.store import schema

app = typer.Typer(add_completion=False)


@app.command()
def dicom_listener(
    host: Annotated[str | None, typer.Option(help="Address to listen on (FLUOROMAP_DICOM_HOST).")] = None,
    port: Annotated[
        int | None, typer.Option(help="Port to listen on (FLUOROMAP_DICOM_PORT).", min=0, max=65535)
    ] = None,
    aet: Annotated[
        str | None, typer.Option(help="Application entity title of the listener (FLUOROMAP_DICOM_AET).")
    ] = None,
    allow: Annotated[
        list[str] | None,
        typer.Option(help="A sender, as AET or AET@address; may be repeated (FLUOROMAP_DICOM_ALLOW).", metavar="AET"),
    ] = None,
    data_dir: DataDir = None,
) -> None:
    """Receive X-ray runs by DICOM C-STORE.

    It speaks TLS when FLUOROMAP_DICOM_TLS_CERTIFICATE names its certificate.
    """
    end_with_supervisor()
    apply_options(data_dir=data_dir)
    apply_settings(dicom_host=host, dicom_port=port, dicom_aet=aet, dicom_allow=",".join(allow) if allow else None)
    logs.configure()
    allowed = AllowList.from_text(settings().dicom_allow)
    if not allowed.senders and not auth.is_loopback(settings().dicom_host):
        raise CommandFailed(
            f"Listening on {settings().dicom_host} needs the senders; name them with --allow AET or --allow AET@address."
        )
    tls = server_context(settings().dicom_tls_certificate, settings().dicom_tls_key, settings().dicom_tls_ca)
    with explain_database_failures():
        schema.check()
    # Importing pynetdicom takes a second: the help does not need it.
    from fluoromap_service.listener import server

    stop = stop_on_signals()
    try:
        listener = server.start(settings().dicom_host, settings().dicom_port, settings().dicom_aet, allowed, tls)
    except OSError as error:
        raise CommandFailed(
            f"The DICOM listener cannot listen on {settings().dicom_host} port {settings().dicom_port} "
            f"({error.strerror}); choose another address with --host or --port."
        ) from error
    file_pool.start()
    address = listener.server_address
    typer.echo(f"fluoromap: {settings().dicom_aet} listens on {address[0]} port {address[1]}")
    stop.wait()
    listener.ae.shutdown()
    file_pool.close()
