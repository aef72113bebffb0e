"""The settings of a process, each a ``FLUOROMAP_*`` environment variable."""

from __future__ import annotations

import functools
import ipaddress
import os
import re
from pathlib import Path

from pydantic import Field, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """The settings of one process; ``FLUOROMAP_DATA_DIR`` gives the field ``data_dir``, and so on."""

    model_config = SettingsConfigDict(env_prefix="FLUOROMAP_", frozen=True)

    data_dir: Path = Field(
        Path.home() / ".fluoromap", description="Folder of the files, and of the embedded database and broker."
    )
    config: str = Field(
        "", description="TOML file with the targets of deliveries and the rules that start jobs; empty: none."
    )
    database_url: str = Field("", description="SQLAlchemy URL; empty: SQLite in the data folder.")
    broker_url: str = Field(
        "", description="Celery broker URL; empty: files in the data folder; 'eager': jobs run at once."
    )
    host: str = Field("127.0.0.1", description="Address the API listens on.")
    port: int = Field(8000, ge=0, le=65535, description="Port the API listens on.")
    cors_origins: str = Field(
        "", description="Web pages that browsers let use the API, as origins with spaces between; empty: none."
    )
    allowed_hosts: str = Field(
        "",
        description="Names under which clients reach the API, with spaces between; loopback names always work; empty: any name.",
    )
    trusted_proxies: str = Field(
        "",
        description="Proxies whose X-Forwarded-For and X-Forwarded-Proto count: addresses or networks, with spaces between.",
    )
    dicom_host: str = Field("127.0.0.1", description="Address the DICOM listener listens on.")
    dicom_port: int = Field(11112, ge=0, le=65535, description="Port the DICOM listener listens on.")
    dicom_aet: str = Field(
        "FLUOROMAP", pattern=r"^[!-\[\]-~]{1,16}$", description="Application entity title of the DICOM listener."
    )
    dicom_allow: str = Field(
        "",
        description="Senders of the DICOM listener: AET or AET@address, with commas between; empty: 'up' starts no listener.",
    )
    dicom_associations: int = Field(
        16, ge=1, description="Associations that the DICOM listener serves at the same time."
    )
    dicom_tls_certificate: str = Field(
        "", description="PEM file with the certificate of the DICOM listener; empty: no TLS."
    )
    dicom_tls_key: str = Field("", description="PEM file with the private key of that certificate.")
    dicom_tls_ca: str = Field(
        "", description="PEM file of authorities: senders need a certificate of one of them; empty: they need none."
    )
    max_upload_bytes: int = Field(
        4 * 2**30, gt=0, description="Largest request body or DICOM object accepted, in bytes."
    )
    min_free_mib: int = Field(
        512, ge=0, description="Free space that requests may not fill, so that running jobs can end, in MiB."
    )
    retention_days: float = Field(
        0.0, ge=0, description="Age at which a study without a change or job is deleted, in days; 0: never."
    )
    audit_head_file: str = Field(
        "", description="File to which the API appends the hash of the audit trail's newest entry; empty: none."
    )
    renderings_mib: int = Field(
        4096, ge=0, description="Space for kept pictures, meshes and reports; the longest unused go first, in MiB."
    )
    downloads: int = Field(4, ge=1, description="Large files that one token may download at the same time.")
    workers: int = Field(
        len(os.sched_getaffinity(0)), ge=1, description="Stages that one worker runs at the same time."
    )
    worker_memory_mib: int = Field(8192, ge=2048, description="Address space one running stage may take, in MiB.")
    stage_seconds: int = Field(
        1800, gt=0, description="Longest time one stage may run before it is stopped, in seconds."
    )
    lease_seconds: float = Field(30.0, gt=0, description="Silence after which a worker counts as dead, in seconds.")
    heartbeat_seconds: float = Field(
        10.0, gt=0, description="Time between a running stage's signs of life, in seconds."
    )
    republish_seconds: float = Field(
        5.0, gt=0, description="Time after which an unclaimed stage is announced again, in seconds."
    )
    max_attempts: int = Field(3, ge=1, description="How often a stage is tried when its worker dies.")

    @field_validator("cors_origins")
    @classmethod
    def _only_origins(cls, value: str) -> str:
        for origin in value.split():
            if not re.fullmatch(r"https?://[^/\s*?#]+", origin):
                raise ValueError(
                    f"{origin!r} is no origin; write scheme, host and port only, as https://viewer.example:8443"
                )
        return value

    @field_validator("allowed_hosts")
    @classmethod
    def _only_names(cls, value: str) -> str:
        for name in value.split():
            if not re.fullmatch(r"[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]", name):
                raise ValueError(f"{name!r} is no host; write the name or address alone, as fluoromap.example")
        return value

    @field_validator("trusted_proxies")
    @classmethod
    def _only_networks(cls, value: str) -> str:
        for proxy in value.split():
            try:
                ipaddress.ip_network(proxy)
            except ValueError:
                raise ValueError(f"{proxy!r} is no address and no network; write 192.0.2.7 or 192.0.2.0/24") from None
        return value

    @property
    def allowed_origins(self) -> tuple[str, ...]:
        """The origins of other web pages that may use the API, without any by default."""
        return tuple(self.cors_origins.lower().split())

    @functools.cached_property
    def allowed_host_names(self) -> frozenset[str]:
        """The names and addresses under which clients may reach the API; empty: any name."""
        return frozenset(name.strip("[]") for name in self.allowed_hosts.lower().split())

    @functools.cached_property
    def effective_database_url(self) -> str:
        return self.database_url or f"sqlite:///{self.data_dir.resolve() / 'fluoromap.sqlite'}"

    @property
    def eager(self) -> bool:
        return self.broker_url == "eager"

    @property
    def files_dir(self) -> Path:
        return self.data_dir / "files"


@functools.cache
def settings() -> Settings:
    """Return the process's settings, read once from the environment."""
    return Settings()
