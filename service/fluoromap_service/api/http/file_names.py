"""Names of files in answers: they hold a site's name and nothing of the patient."""

from __future__ import annotations

import re


def plain(site: str) -> str:
    """A site's name with everything but letters, digits, dot, dash and underscore replaced; never empty or hidden."""
    return re.sub(r"[^A-Za-z0-9._-]", "_", site).lstrip(".") or "site"
