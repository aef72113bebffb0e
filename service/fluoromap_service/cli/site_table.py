"""The sites of a study with their runs, as a person checks them on the terminal before a job."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from fluoromap.reasons import Reason
from fluoromap_service.cli.client import Client
from fluoromap_service.cli.study_file import NAME
from fluoromap_service.cli.submission import Submission
from fluoromap_service.dicom.facts import HeaderWarning
from fluoromap_service.study.instances import GANTRY_KEYWORDS

_VIEWS = ("view_a", "view_b")
_UNBOUND = "unbound"
_FIELD_OF = {keyword: field for field, keyword in GANTRY_KEYWORDS.items()}


@dataclass(frozen=True, slots=True)
class SiteTable:
    """The sites, pairs and runs of a study as the API shows them.

    Parameters
    ----------
    sites : sequence of dict
        The sites, then the pairs of runs without a name (``site`` is None).
    runs : mapping of str to dict
        SOP Instance UID -> run.
    files : mapping of str to str
        SOP Instance UID -> file of the user.
    """

    sites: Sequence[dict[str, Any]]
    runs: Mapping[str, dict[str, Any]]
    files: Mapping[str, str]

    @classmethod
    def of(cls, client: Client, sent: Submission) -> SiteTable:
        """Read the table of a study that was sent."""
        runs = {run["sop_instance_uid"]: run for run in client.instances(sent.study)}
        return cls(client.sites(sent.study), runs, sent.files)

    @property
    def ready(self) -> list[dict[str, Any]]:
        """The sites that a job can use."""
        return [site for site in self.sites if site["ready"]]

    @property
    def pairs(self) -> list[dict[str, Any]]:
        """The pairs of runs that nobody has named."""
        return [site for site in self.sites if site["site"] is None]

    @property
    def rows_without_runs(self) -> list[dict[str, Any]]:
        """The sites that have an activation time and no run."""
        return [
            site
            for site in self.sites
            if site["lat_ms"] is not None and site["view_a"] is None and site["view_b"] is None
        ]

    @property
    def guesses(self) -> list[dict[str, Any]]:
        """The sites whose runs are a guess by row order."""
        return [site for site in self.sites if site["bound_by"] == "order"]

    def table(self) -> Table:
        """Return one row for each site and each pair without a name.

        The column "angle" is the angle between the two views.
        """
        table = Table(title="Runs of the sites", box=box.SIMPLE_HEAD, leading=1)
        for title, numeric in (
            ("site", False), ("view a", False), ("view b", False), ("angle", True), ("LAT ms", True),
            ("missing", False), ("bound by", False), ("warnings", False),
        ):  # fmt: skip
            table.add_column(title, justify="right" if numeric else "left", overflow="fold")
        for site in self.sites:
            angle, lat = site["angle_deg"], site["lat_ms"]
            cells = (
                _name(site), self._view(site["view_a"]), self._view(site["view_b"]),
                "-" if angle is None else f"{angle:.0f} deg", "-" if lat is None else f"{lat:.1f}",
                "\n".join(self._missing(site)), site["bound_by"] or "-", "\n".join(self._warnings(site)),
            )  # fmt: skip
            # A name may have brackets, which rich would take as markup.
            table.add_row(*(Text(cell) for cell in cells))
        return table

    def _view(self, uid: str | None) -> str:
        return "-" if uid is None else f"{self.files[uid]}\n{_angles(self.runs[uid]['gantry'])}"

    def _missing(self, site: dict[str, Any]) -> list[str]:
        items = []
        for item in site["missing"]:
            view = item.removeprefix("gantry:")
            items.append(item if view == item else f"{view}: {', '.join(self.runs[site[view]]['missing'])}")
        return items

    def _warnings(self, site: dict[str, Any]) -> list[str]:
        runs = [self.runs[site[view]] for view in _VIEWS if site[view] is not None]
        return list(dict.fromkeys([*site["warnings"], *(code for run in runs for code in run["warnings"])]))

    def explanations(self) -> list[str]:
        """Return one sentence for each warning and for each unused run."""
        codes = dict.fromkeys(code for site in self.sites for code in self._warnings(site))
        unused = [uid for uid, run in self.runs.items() if _UNBOUND in run["warnings"]]
        return [f"{code}: {_sentence(code)}" for code in codes] + [
            f"No site has the run {self.files[uid]} ({_angles(self.runs[uid]['gantry'])})." for uid in unused
        ]

    def not_ready(self) -> list[str]:
        """Return one sentence for each site or pair that is not ready."""
        return [
            f"{'site ' if site['site'] else ''}{_name(site)} is not ready: {', '.join(self._needs(site))}"
            for site in self.sites
            if not site["ready"]
        ]

    def _needs(self, site: dict[str, Any]) -> list[str]:
        missing = self._missing(site)
        return [f"missing {', '.join(missing)}"] if missing else list(site["warnings"])

    def refusal(self) -> str | None:
        """Return why the service would refuse a job and what to do.

        None when the service would accept a job.
        """
        rows, pairs = self.rows_without_runs, self.pairs
        if rows and pairs:
            return (
                f"{len(rows)} sites have an activation time but no run, and {len(pairs)} pairs of runs have no site. "
                f"Say which runs belong to which site: in {NAME}, or in the columns view_a and view_b of the table."
            )
        if self.ready:
            return None
        return " ".join(["No site is ready.", *self._remedies()])

    def _remedies(self) -> Iterator[str]:
        missing = {item for site in self.sites for item in site["missing"]}
        keywords = {key for run in self.runs.values() for key in run["missing"]}
        if not self.sites:
            yield f"No two runs make a pair; name the two runs of each site in {NAME}."
        if "site" in missing:
            yield f"Give each pair of runs a site in {NAME}."
        if "lat_ms" in missing:
            yield f"Add the missing activation times to the table, or as lat_ms in {NAME}."
        if missing & set(_VIEWS):
            yield f"Name the missing runs as view_a and view_b in {NAME}."
        if keywords:
            fields = ", ".join(field for keyword, field in _FIELD_OF.items() if keyword in keywords)
            yield f"Add the missing geometry under [gantry] in {NAME}: {fields}."
        codes = {code for site in self.sites for code in site["warnings"]} - {str(Reason.PAIRED_BY_ORDER)}
        yield from (_sentence(code) for code in sorted(codes))

    def lines_to_confirm(self) -> str:
        """Return lines of ``study.toml`` for guessed runs and unnamed pairs.

        An empty text when there are none.
        """
        return "\n\n".join(self._entry(site) for site in (*self.guesses, *self.pairs))

    def _entry(self, site: dict[str, Any]) -> str:
        name = f"NAME_OF_PAIR_{site['pair']}" if site["site"] is None else site["site"]
        lines = [f"{view} = {_quoted(self.files[site[view]])}" for view in _VIEWS if site[view] is not None]
        return "\n".join([f"[sites.{name if re.fullmatch('[A-Za-z0-9_-]+', name) else _quoted(name)}]", *lines])


def _name(site: dict[str, Any]) -> str:
    return f"pair {site['pair']}" if site["site"] is None else str(site["site"])


def _angles(gantry: dict[str, Any]) -> str:
    primary, secondary = gantry["primary_deg"], gantry["secondary_deg"]
    if primary is None or secondary is None:
        return "angles missing"
    sides = "LAO" if primary >= 0 else "RAO", "CRA" if secondary >= 0 else "CAU"
    return f"{sides[0]} {abs(primary):.1f}, {sides[1]} {abs(secondary):.1f}"


def _sentence(code: str) -> str:
    return Reason(code).sentence if code in set(Reason) else HeaderWarning(code).sentence


def _quoted(text: str) -> str:
    # A basic string of TOML is a string of JSON, but for DEL.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
